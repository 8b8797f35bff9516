"""The shipped notebooks, and the functions that execute and check them.

`make test` also runs every notebook at scale smoke, through nbmake.
"""

from pathlib import Path

import nbformat
import pytest

from tools import notebooks

SHIPPED = sorted((Path(__file__).resolve().parent.parent / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_shipped_notebook_is_executed_and_clean(path):
    assert notebooks.problems(path) == []


def write(path, *sources):
    cells = [nbformat.v4.new_markdown_cell("text")]
    cells += [nbformat.v4.new_code_cell(source) for source in sources]
    nbformat.write(nbformat.v4.new_notebook(cells=cells), path)
    return path


def test_execute_saves_the_same_file_twice(tmp_path, capsys):
    bar = "print('10 %', end='\\r'); print('99 %')"
    path = write(tmp_path / "a.ipynb", bar, "print('a'); print('b')", "1 + 2")
    assert notebooks.problems(path)
    notebooks.execute(path)
    assert "cell 3 of 3: " in capsys.readouterr().out
    first = path.read_text()
    notebooks.execute(path)
    assert path.read_text() == first
    assert notebooks.problems(path) == []
    cells = nbformat.read(path, as_version=4).cells[1:]
    assert [cell.outputs[0].text for cell in cells[:2]] == ["99 %\n", "a\nb\n"]
    assert cells[2].outputs[0].data["text/plain"] == "3"


def test_failed_notebook_is_left_as_it_was(tmp_path, capsys):
    path = write(tmp_path / "a.ipynb", "1 / 0")
    before = path.read_text()
    assert notebooks.main([str(path)]) == 1
    assert path.read_text() == before
    assert "ZeroDivisionError" in capsys.readouterr().out
    assert notebooks.main([str(tmp_path / "none.ipynb")]) == 1


@pytest.mark.parametrize(
    "cell, problem",
    [
        ({"source": "x\n" * 31}, "31 lines"),
        ({"source": "x", "execution_count": 7}, "execution counts"),
        ({"source": "x", "outputs": [("stream", {"name": "stderr", "text": "W"})]}, "stderr: W"),
        ({"source": "x", "outputs": [("stream", {"text": "<A at 0x7f00aa11>"})]}, "address"),
        ({"source": "x", "outputs": [("error", {"ename": "E", "evalue": "e"})]}, "ended with E"),
        ({"source": "open('/home/me/x')"}, "path of one machine"),
    ],
)
def test_problems_are_found(tmp_path, cell, problem):
    cell = {"execution_count": 1, **cell}
    outputs = [nbformat.v4.new_output(kind, **data) for kind, data in cell.pop("outputs", [])]
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(outputs=outputs, **cell)])
    nbformat.write(notebook, tmp_path / "a.ipynb")
    (found,) = notebooks.problems(tmp_path / "a.ipynb")
    assert problem in found
