"""Execute notebooks so that they can be shipped with their outputs, and check what is shipped.

    python -m tools.notebooks notebooks/*.ipynb           execute, save in place and check
    python -m tools.notebooks --check notebooks/*.ipynb   only check

A notebook is run from its first cell in a fresh kernel, and saved without anything that changes
from run to run by itself (times, versions of the kernel, widget states).
"""

import argparse
import re
import sys
import tempfile
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbconvert.preprocessors import ClearMetadataPreprocessor

from shapebody.files import atomic_write

LONGEST_CELL = 30
"""Lines of code."""
LONGEST_SILENCE = 10.0
"""Seconds of a cell without output."""
LARGEST_FILE = 1.5e6
"""Bytes."""
METADATA = {
    "kernelspec": {"display_name": "Python 3 (ipykernel)", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}


class Listener(NotebookClient):
    """Executes a notebook and notes how long its cells say nothing: readers think they hang."""

    def begin(self) -> None:
        """A cell begins."""
        self.began = self.heard = time.perf_counter()
        self.silence = 0.0

    def pause(self) -> tuple[float, float]:
        """A cell has ended: its seconds, and the longest time without output."""
        self._hear()
        return self.heard - self.began, self.silence

    def _hear(self) -> None:
        now = time.perf_counter()
        self.silence, self.heard = max(self.silence, now - self.heard), now

    def process_message(self, msg, cell, cell_index):
        if msg["msg_type"] in ("stream", "display_data", "update_display_data"):
            self._hear()
        return super().process_message(msg, cell, cell_index)


def execute(path: Path, timeout: float | None = None) -> None:
    """Run a notebook, with a line of progress per cell, and save it in place.

    The file is replaced only if every cell ran; nbclient's CellExecutionError otherwise. Cells
    tagged "raises-exception" may raise. timeout: seconds for one cell.
    """
    notebook = nbformat.read(path, as_version=4)
    total, number = len(code_cells(notebook)), 0

    def done(cell, **_):
        nonlocal number
        number += 1
        seconds, silence = client.pause()
        note = f", of which {silence:.0f} s without a word" if silence > LONGEST_SILENCE else ""
        print(f"  cell {number} of {total}: {seconds:.1f} s{note}", flush=True)

    client = Listener(
        notebook,
        timeout=timeout,
        kernel_name="python3",
        record_timing=False,
        coalesce_streams=True,  # also keeps only the last state of a progress bar
        store_widget_state=False,
        resources={"metadata": {"path": str(path.parent)}},
        on_cell_execute=lambda **_: client.begin(),
        on_cell_executed=done,
    )
    client.execute()
    atomic_write(path, nbformat.writes(clean(notebook)) + "\n")


def clean(notebook):
    """The notebook without metadata that say when and with what it was run."""
    clear = ClearMetadataPreprocessor(enabled=True, preserve_cell_metadata_mask={"tags", "jupyter"})
    notebook, _ = clear.preprocess(notebook, {})
    notebook.metadata = nbformat.from_dict(METADATA)
    return notebook


def code_cells(notebook) -> list:
    """The cells that are executed."""
    return [cell for cell in notebook.cells if cell.cell_type == "code" and cell.source.strip()]


def problems(path: Path) -> list[str]:
    """What keeps a notebook from being shipped, one sentence each; empty if nothing."""
    text = path.read_text(encoding="utf-8")
    cells = code_cells(nbformat.reads(text, as_version=4))
    counts, found = [cell.execution_count for cell in cells], []
    if counts != list(range(1, len(cells) + 1)):
        found.append(f"execution counts are {counts}: run `make notebooks NOTEBOOKS={path}`")
    for number, cell in enumerate(cells, 1):
        lines = len(cell.source.splitlines())
        if lines > LONGEST_CELL:
            found.append(f"code cell {number} has {lines} lines, at most {LONGEST_CELL} fit a page")
        on_purpose = "raises-exception" in cell.metadata.get("tags", [])
        for output in cell.outputs:
            if output.output_type == "error" and not on_purpose:
                found.append(f"code cell {number} ended with {output.ename}: {output.evalue}")
            if output.get("name") == "stderr":
                found.append(f"code cell {number} wrote to stderr: {output.text.strip()[:200]}")
        if re.search(r" at 0x[0-9a-f]{6,}", str(cell.outputs)):
            found.append(f"an output of code cell {number} holds a memory address")
    size = len(text.encode())
    if size > LARGEST_FILE:
        found.append(f"{size / 1e6:.1f} MB, at most {LARGEST_FILE / 1e6:.1f}")
    folders = {str(Path.home()), str(Path.cwd()), tempfile.gettempdir(), "/home", "/Users"} - {"/"}
    for folder in sorted(folders):
        if re.search(re.escape(folder) + r"/\w", text):
            found.append(f"a path of one machine, {folder}/..., is in its text or outputs")
    return found


def main(arguments=None) -> int:
    """Execute and check notebooks; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tools.notebooks", description=__doc__)
    parser.add_argument("notebook", nargs="*", type=Path)
    parser.add_argument("--check", action="store_true", help="only check, execute nothing")
    options = parser.parse_args(arguments)
    failed = 0
    for path in options.notebook:
        try:
            if not options.check:
                print(path, flush=True)
                execute(path)
            found = problems(path)
        except Exception as error:  # of a cell, of the kernel, of the file
            found = [f"failed and was left as it was:\n{error}"]
        print(*(f"{path}: {problem}" for problem in found), sep="\n", end="\n" if found else "")
        failed += bool(found)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
