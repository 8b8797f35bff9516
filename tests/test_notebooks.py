"""The shipped notebooks, and the functions that execute and check them.

`make test` also runs every notebook at scale smoke, through nbmake.
"""

from pathlib import Path

import nbformat
import pytest

from shapebody import notebooks

SHIPPED = sorted((Path(__file__).resolve().parent.parent / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_shipped_notebook_is_executed_and_clean(path):
    assert notebooks.problems(path) == []


def write(path, *sources):
    cells = [nbformat.v4.new_code_cell(source) for source in sources]
    nbformat.write(nbformat.v4.new_notebook(cells=cells), path)
    return path


def test_execute_saves_the_same_file_twice(tmp_path):
    path = write(tmp_path / "a.ipynb", "x = 1\nprint('a'); print('b')", "x + 1")
    assert notebooks.problems(path)
    notebooks.execute(path)
    first = path.read_text()
    notebooks.execute(path)
    assert path.read_text() == first
    assert notebooks.problems(path) == []
    cells = nbformat.read(path, as_version=4).cells
    assert cells[0].outputs[0].text == "a\nb\n"
    assert cells[1].outputs[0].data["text/plain"] == "2"


def test_failed_notebook_is_left_as_it_was(tmp_path, capsys):
    path = write(tmp_path / "a.ipynb", "1 / 0")
    before = path.read_text()
    assert notebooks.main([str(path)]) == 1
    assert path.read_text() == before
    assert "ZeroDivisionError" in capsys.readouterr().err


def test_progress_bars_keep_their_last_state():
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell("bar()")])
    notebook.cells[0].outputs = [
        nbformat.v4.new_output("stream", name="stdout", text=" 10 %\r"),
        nbformat.v4.new_output("stream", name="stdout", text=" 50 %\r100 %\ndone\n"),
    ]
    notebooks.normalise(notebook)
    assert [output.text for output in notebook.cells[0].outputs] == ["100 %\ndone\n"]


@pytest.mark.parametrize(
    "cell, problem",
    [
        ({"source": "x\n" * 31}, "31 lines"),
        ({"source": "!pip install x"}, "installs packages"),
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
