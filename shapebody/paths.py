"""Where the shipped data lives."""

import os
from pathlib import Path

from shapebody.checks import require_path


def data_dir() -> Path:
    """Folder with robots, checkpoints and results.

    `<repository>/data`, or the folder named by the environment variable `SHAPEBODY_DATA`.
    Raises FileNotFoundError if that folder does not exist.
    """
    override = os.environ.get("SHAPEBODY_DATA")
    shipped = Path(__file__).resolve().parent.parent / "data"
    folder = require_path("SHAPEBODY_DATA", override) if override else shipped
    if not folder.is_dir():
        raise FileNotFoundError(
            f"data folder {str(folder)!r} does not exist: set SHAPEBODY_DATA to the 'data' folder "
            "of a shapebody checkout, or install with 'pip install -e .' inside the checkout"
        )
    return folder
