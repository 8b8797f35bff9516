import matplotlib.pyplot as plt
import numpy as np
import pytest

from shapebody import load_agent
from shapebody.show import plots, tables


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
    first, second = tables.agents_table(agents).rows
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
    table = tables.paper_table(
        [("return", 42.6, (41.97, 0.312)), ("steps", None, 13_000_000)], note="ours (reduced)"
    )
    assert table.markdown().splitlines()[2:] == [
        "| return | 42.60 | 41.97 ± 0.31 |",
        "| steps | – | 13,000,000 |",
    ]
    assert "ours (reduced)" in table._repr_html_()
    assert str(table).splitlines()[1].endswith("41.97 ± 0.31")


def test_table_escapes_html():
    assert "&lt;b&gt;" in tables.table([("<b>", 1)], ("a", "b"))._repr_html_()


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
