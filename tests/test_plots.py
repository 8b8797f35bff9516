import matplotlib.pyplot as plt
import numpy as np
import pytest

from shapebody import load_agent
from shapebody.show import diagrams, plots, study_plots, tables


@pytest.fixture
def curve(tmp_path):
    path = tmp_path / "curve.csv"
    path.write_text("steps,return\n0,1.0\n10,3.0\n20,\n30,5.0\n")
    return path


def test_learning_curve(curve):
    ax = plots.learning_curve(curve, "return", label="reduced")
    (line,) = ax.lines
    assert line.get_xdata().tolist() == [0, 10, 20, 30]
    assert np.array_equal(line.get_ydata(), [1, 3, np.nan, 5], equal_nan=True)
    plt.close("all")


def test_smoothing_skips_missing_values(curve):
    smooth, raw = plots.learning_curve(curve, "return", smooth=3).lines
    assert smooth.get_ydata() == pytest.approx([2, 2, 4, 5])
    assert len(raw.get_ydata()) == 4
    plt.close("all")


def test_smoothing_draws_nothing_where_nothing_is_known(tmp_path):
    path = tmp_path / "curve.csv"
    path.write_text("steps,return\n" + "".join(f"{i},\n" for i in range(5)) + "5,4\n6,6\n")
    smooth = plots.learning_curve(path, "return", smooth=3).lines[0].get_ydata()
    assert np.isnan(smooth[:4]).all() and smooth[4:] == pytest.approx([4, 5, 5])
    plt.close("all")


def test_agents_table():
    agents = [load_agent(name) for name in ("unitree_go2", "golem")]
    first, second = tables.agents_table(agents).data.values.tolist()
    assert first[0] == "unitree_go2" and first[1].endswith(" million")
    assert 0 < float(second[2]) <= 1
    assert "million, " in second[3] and second[3].endswith(" actions")
    for agent, row in zip(agents, (first, second), strict=True):
        scales = (agent.policy_config.latent_scale, agent.critic_config.latent_scale)
        assert row[4] == "{:g}, {:g}".format(*scales)


def test_missing_column_is_named(curve):
    with pytest.raises(ValueError, match="no column 'reward'; it has steps, return"):
        plots.learning_curve(curve, "reward")


def test_paper_table():
    rows = [("return", 42.6, (41.97, 0.312)), ("steps", None, 13_000_000)]
    table = tables.paper_table(rows, note="ours (reduced)", caption="a < b")
    assert table.data.values.tolist() == [
        ["return", "42.60", "41.97 ± 0.31"],
        ["steps", "–", "13,000,000"],
    ]
    assert repr(table).splitlines() == [
        "a < b",
        "        paper  ours (reduced)",
        "return  42.60    41.97 ± 0.31",
        "steps       –      13,000,000",
    ]
    page = table.to_html()
    assert "ours (reduced)" in page and "<caption>a &lt; b</caption>" in page
    assert f"td.col1 {{\n  color: {tables.PAPER_TEXT}" in page
    again = tables.paper_table(rows, note="ours (reduced)", caption="a < b")
    assert again.to_html() == page  # no identifier by chance
    assert tables.table([], ("a", "b")).to_html()


@pytest.mark.parametrize(
    "title, grey",
    [
        ("paper", True),
        ("paper ΔR", True),
        ("critic: paper", True),
        ("paper | ours", False),
        ("the paper's starts", False),
    ],
)
def test_columns_of_the_paper_are_grey(title, grey):
    page = tables.table([("a", 1)], ("", title)).to_html()
    assert (tables.PAPER_TEXT in page) is grey


def test_table_escapes_html():
    page = tables.table([("<b>", 1)], ("<i>", "b")).to_html()
    assert "&lt;b&gt;" in page and "&lt;i&gt;" in page


def test_titles_of_columns_differ():
    with pytest.raises(ValueError, match="titles that differ"):
        tables.table([(1, 2)], ("ours", "ours"))


def test_interval():
    gain = (1.234, -0.5, 2.0, "differences")
    assert tables.interval(gain) == "+1.23 [-0.50, +2.00]"
    assert tables.interval(dict(mean=1.0, low=0.0, high=2.0), 1) == "+1.0 [+0.0, +2.0]"


def test_ragged_rows_are_refused():
    with pytest.raises(ValueError, match="3 cells"):
        tables.table([(1, 2, 3)], ("a", "b"))


def test_intervals_have_one_row_each():
    figure, ax = plt.subplots()
    values = [(1.0, 0.5, 1.5), None, (3.0, 2.0, 5.0)]
    assert plots.intervals(["a", "b", "c"], values, ["red", "green", "black"], ax) is ax
    assert [label.get_text() for label in ax.get_yticklabels()] == ["a", "b", "c"]
    bars, points = ax.get_lines()[::2], ax.get_lines()[1::2]
    assert [list(bar.get_xdata()) for bar in bars] == [[0.5, 1.5], [2.0, 5.0]]
    assert [point.get_ydata()[0] for point in points] == [0, 2]
    assert [point.get_color() for point in points] == ["red", "black"]
    plt.close(figure)


def test_panels_have_a_title_each():
    axes = plots.panels(["a", "b"])
    assert [ax.get_title() for ax in axes] == ["a", "b"]
    rows = plots.panels(["a", "b", "c"], columns=2)
    assert [[ax.get_title() for ax in row] for row in rows] == [["a", ""], ["b", ""], ["c", ""]]
    with pytest.raises(ValueError, match="titles is empty"):
        plots.panels([])
    plt.close("all")


def test_one_legend_for_all_panels():
    axes = plots.panels(["a", "b"])
    axes[0].plot([0, 1], label="both")
    for label in ("both", "second only"):
        axes[1].plot([0, 1], label=label)
    plots.legend_beside(axes)
    assert axes[0].get_legend() is None
    assert [t.get_text() for t in axes[1].get_legend().get_texts()] == ["both", "second only"]
    plt.close("all")


def test_folded_tables_open_with_a_click_and_print_at_once():
    folded = tables.Folded("more < less", *(tables.table([(x, 1)], ("", "b")) for x in "xy"))
    page = folded._repr_html_()
    assert (
        page.startswith("<details><summary>more &lt; less</summary>") and page.count("<table") == 2
    )
    assert "x  1" in repr(folded) and "y  1" in repr(folded)


@pytest.mark.parametrize("name", ["pipeline", "urma", "critics", "actor_and_learner"])
def test_diagrams_are_drawn_within_their_frame(name):
    figure = getattr(diagrams, name)()
    figure.canvas.draw()
    for text in figure.axes[0].texts:
        box = text.get_window_extent()
        assert 0 <= box.x0 < box.x1 <= figure.bbox.width, text.get_text()
    plt.close(figure)


def test_a_ranking_shows_the_papers_value_where_ours_is_missing():
    ax = plots.panels(["a"])[0]
    rows = {m: dict(mean=x, low=x - 1, high=x + 1) for m, x in (("vgds", 2.0), ("cem", 1.0))}
    study_plots.ranking(ax, rows, {"vgds": "VGDS", "cem": "CEM", "bo": "BO"}, {"bo": 5.0})
    assert [label.get_text() for label in ax.get_yticklabels()] == ["BO", "CEM", "VGDS"]
    diamonds = [line for line in ax.lines if line.get_marker() == "D"]
    assert [(line.get_xdata()[0], line.get_ydata()[0]) for line in diamonds] == [(5.0, 0)]
    plt.close("all")
