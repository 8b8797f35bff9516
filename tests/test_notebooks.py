"""The shipped notebooks, and the functions that execute and check them.

`make test` also runs every notebook at scale smoke, through nbmake.
"""

import re
from pathlib import Path

import nbformat
import pytest

from tools import notebooks

SHIPPED = sorted((Path(__file__).resolve().parent.parent / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_shipped_notebook_is_executed_and_clean(path):
    assert notebooks.problems(path) == []


def prose(path) -> list[str]:
    cells = nbformat.read(path, as_version=4).cells
    return [cell.source for cell in cells if cell.cell_type == "markdown"]


HEADER = ["Shows", "Paper", "2 CPU cores", "GPU", "Before", "Next"]


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_headers_are_alike_and_lead_from_one_to_the_next(path):
    first, place = prose(path)[0], SHIPPED.index(path)
    assert first.startswith(f"# {path.name[:2]} · ")
    rows = dict(re.findall(r"^\| ([^|]+) \| ([^|]+) \|$", first, re.MULTILINE))
    assert list(rows) == HEADER
    neighbours = {"Before": SHIPPED[place - 1 :][:1] if place else [], "Next": SHIPPED[place + 1 :]}
    for row, others in neighbours.items():
        names = re.findall(r"\]\(([^)]+)\)", rows[row])
        assert names == [other.name for other in others[:1]], row


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_notebooks_end_alike_and_their_links_lead_somewhere(path):
    text = "\n".join(prose(path))
    ends = re.findall(r"^## (Takeaways|Exercises|References)$", text, re.MULTILINE)
    assert ends == ["Takeaways", "Exercises", "References"]
    assert "](https://" in text[text.index("## References") :]
    inside = [link for link in re.findall(r"\]\(([^)]+)\)", text) if "://" not in link]
    assert inside and all((path.parent / link).exists() for link in inside)
    assert not re.search(r"\b[Nn]otebook \d", text), "refer by a link, not by a number alone"


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
