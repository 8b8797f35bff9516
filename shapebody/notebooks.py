"""Execute notebooks so that they can be shipped with their outputs, and check what is shipped.

    python -m shapebody.notebooks notebooks/*.ipynb

runs each from its first cell in a fresh kernel and saves it in place, without anything that changes
from run to run by itself (times, versions of the kernel, widget states).
"""

import argparse
import os
import re
import sys
import tempfile
import time
from pathlib import Path

import nbformat

from shapebody.arguments import require_file, require_kind, require_number
from shapebody.files import atomic_write

LONGEST_CELL = 30
"""Lines of code."""
LARGEST_FILE = 1.5e6
"""Bytes."""

_KERNEL = {"display_name": "Python 3 (ipykernel)", "language": "python", "name": "python3"}
_KEPT_METADATA = ("tags", "jupyter", "slideshow")
_ADDRESS = re.compile(r" at 0x[0-9a-f]{6,}")


def execute(path: str | Path, timeout: float | None = None) -> float:
    """Run a notebook and save it in place; returns the seconds it took.

    The file is replaced only if every cell ran; nbclient's CellExecutionError otherwise. Cells
    tagged "raises-exception" may raise. timeout: seconds for one cell.
    """
    from nbclient import NotebookClient

    path = require_file("path", path)
    if timeout is not None:
        require_number("timeout", timeout, above=0)
    notebook = _read(path)
    for cell in _code(notebook):
        cell.outputs, cell.execution_count = [], None
    client = NotebookClient(
        notebook,
        timeout=timeout,
        kernel_name="python3",
        record_timing=False,
        store_widget_state=False,
        resources={"metadata": {"path": str(path.parent)}},
    )
    start = time.perf_counter()
    client.execute()
    seconds = time.perf_counter() - start
    normalise(notebook)
    atomic_write(path, nbformat.writes(notebook) + "\n")
    return seconds


def _read(path: Path):
    """A notebook; ValueError for a file that is none."""
    try:
        notebook = nbformat.read(path, as_version=4)
        nbformat.validate(notebook)
    except Exception as error:  # of nbformat, jsonschema, json, and what they do not catch
        raise ValueError(f"{path} is no notebook ({type(error).__name__})") from error
    return notebook


def normalise(notebook) -> None:
    """Remove, in place, what differs between two runs with the same results."""
    require_kind("notebook", notebook, nbformat.NotebookNode, "from nbformat.read")
    notebook.metadata = nbformat.from_dict(
        {"kernelspec": _KERNEL, "language_info": {"name": "python"}}
    )
    for cell in notebook.cells:
        cell.metadata = nbformat.from_dict(
            {key: cell.metadata[key] for key in _KEPT_METADATA if key in cell.metadata}
        )
    for cell in _code(notebook):
        merged = []
        for output in cell.outputs:
            if "metadata" in output:
                output.metadata.pop("isolated", None)
            if output.output_type == "stream":
                if merged and merged[-1].get("name") == output.name:
                    merged[-1].text += output.text
                    continue
            merged.append(output)
        for output in merged:
            if output.output_type == "stream":
                output.text = _last_of_rewritten_lines(output.text)
        cell.outputs = merged


def _last_of_rewritten_lines(text):
    """A progress bar writes one line many times, each time after a carriage return."""
    lines = text.replace("\r\n", "\n").split("\n")
    return "\n".join(line.rstrip("\r").split("\r")[-1] for line in lines)


def problems(path: str | Path) -> list[str]:
    """What keeps a notebook from being shipped, one sentence each; empty if nothing."""
    path = require_file("path", path)
    text = path.read_text(encoding="utf-8")
    notebook = _read(path)
    code = [cell for cell in _code(notebook) if cell.source.strip()]
    counts = [cell.execution_count for cell in code]
    found = []
    if counts != list(range(1, len(code) + 1)):
        found.append(f"execution counts are {counts}: run `make notebooks NOTEBOOKS={path}`")
    for number, cell in enumerate(code, 1):
        lines = len(cell.source.splitlines())
        if lines > LONGEST_CELL:
            found.append(f"code cell {number} has {lines} lines, at most {LONGEST_CELL} fit a page")
        if re.search(r"^\s*[!%]\s*(pip|conda|apt)\b", cell.source, re.MULTILINE):
            found.append(f"code cell {number} installs packages; that is environment.lock's part")
        on_purpose = "raises-exception" in cell.metadata.get("tags", [])
        for output in cell.outputs:
            if output.output_type == "error" and not on_purpose:
                found.append(f"code cell {number} ended with {output.ename}: {output.evalue}")
            if output.get("name") == "stderr":
                found.append(f"code cell {number} wrote to stderr: {output.text.strip()[:200]}")
        if _ADDRESS.search(str(cell.outputs)):
            found.append(f"an output of code cell {number} holds a memory address")
    if len(text.encode()) > LARGEST_FILE:
        found.append(f"{len(text.encode()) / 1e6:.1f} MB, at most {LARGEST_FILE / 1e6:.1f}")
    folders = {os.path.expanduser("~"), str(Path.cwd()), tempfile.gettempdir(), "/home", "/Users"}
    for folder in sorted(folders - {"/", "~"}):
        if re.search(re.escape(folder) + r"/\w", text):
            found.append(f"a path of one machine, {folder}/..., is in its text or outputs")
    return found


def _code(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def parser() -> argparse.ArgumentParser:
    """The options of the command."""
    parser = argparse.ArgumentParser(prog="python -m shapebody.notebooks", description=__doc__)
    parser.add_argument("notebook", nargs="*", type=Path)
    parser.add_argument("--check", action="store_true", help="only check, execute nothing")
    return parser


def main(arguments=None) -> int:
    """Execute and check notebooks; returns the exit status."""
    options = parser().parse_args(arguments)
    failed = 0
    for path in options.notebook:
        try:
            require_file("notebook", path)
        except (ValueError, OSError) as error:
            print(error, file=sys.stderr)
            failed += 1
            continue
        if not options.check:
            print(f"{path} ...", flush=True)
            try:
                print(f"{path}: {execute(path) / 60:.1f} minutes", flush=True)
            except Exception as error:
                print(f"{path} failed and was left as it was:\n{error}", file=sys.stderr)
                failed += 1
                continue
        try:
            found = problems(path)
        except (ValueError, OSError) as error:
            found = [str(error)]
        for problem in found:
            print(f"{path}: {problem}")
        failed += bool(found)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
