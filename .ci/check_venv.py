"""check_venv.py STAMP [--write]: is all that was installed in this environment still there?

Exit status 1 if not. What is damaged is forgotten, so that the next installation puts it back. With
--write, the stamp gets the names of what is there now.
"""

import csv
import importlib.util
import os
import re
import shutil
import sys
import sysconfig
from pathlib import Path


def main(stamp: Path, write: bool) -> int:
    found, damaged = set(), {}
    for site in {Path(sysconfig.get_path(kind)) for kind in ("purelib", "platlib")}:
        for folder in sorted(site.glob("*.dist-info")):
            name = re.sub(r"[-_.]+", "-", folder.name.split("-")[0]).lower()
            found.add(name)
            if not is_whole(folder):
                damaged[name] = folder
    if write:
        stamp.write_text("".join(f"{name}\n" for name in sorted(found)))
        return 0
    gone = set(stamp.read_text().split()) - found
    spec = importlib.util.find_spec("shapebody")  # this runs isolated, so not from the work folder
    here = Path("shapebody", "__init__.py")
    if not (spec and spec.origin and os.path.samefile(spec.origin, here)):
        gone.add("shapebody")
    for folder in damaged.values():
        shutil.rmtree(folder)
    names = sorted(gone | set(damaged))
    if names:
        print(f"make: the environment lacks (parts of) {', '.join(names)}; repairing it")
    return 1 if names else 0


def is_whole(folder: Path) -> bool:
    """Whether every file of a package is there, but for those that Python makes."""
    try:
        with open(folder / "RECORD", newline="", encoding="utf-8") as record:
            files = [row[0] for row in csv.reader(record) if row]
    except OSError:
        return False
    site = str(folder.parent)
    return all(os.path.exists(os.path.join(site, file)) or file.endswith(".pyc") for file in files)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), "--write" in sys.argv[2:]))
