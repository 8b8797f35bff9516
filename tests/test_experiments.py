import json

import numpy as np
import pytest

from shapebody.agent.agent import Agent
from shapebody.evaluation import statistics
from shapebody.reproduction import gains, scale
from shapebody.reproduction import results as reproduction_results


class Known(Agent):
    """An agent that has nothing but what tells it from others."""

    hash, states_hash = None, None

    def __init__(self, hash, states_hash="56"):
        known = dict(name="a", metadata={"steps": 7}, hash=hash, states_hash=states_hash)
        for name, value in known.items():
            object.__setattr__(self, name, value)


AGENT = Known("1234")


@pytest.fixture
def results(tmp_path, monkeypatch):
    monkeypatch.setenv("SHAPEBODY_DATA", str(tmp_path))
    monkeypatch.setenv("SHAPEBODY_SCALE", "reduced")
    return tmp_path / "results"


class Computation:
    def __init__(self):
        self.calls = 0

    def __call__(self):
        self.calls += 1
        return [{"call": self.calls}]


# scales


def test_scale_is_read_from_the_environment(monkeypatch):
    monkeypatch.delenv("SHAPEBODY_SCALE", raising=False)
    assert scale.scale() == "reduced"
    monkeypatch.setenv("SHAPEBODY_SCALE", "smoke")
    assert scale.budget().starts == scale.BUDGETS["smoke"].starts
    monkeypatch.setenv("SHAPEBODY_SCALE", "huge")
    with pytest.raises(ValueError, match="huge.*smoke, reduced, full"):
        scale.scale()


def test_scales_table_has_a_row_per_scale():
    rows = scale.scales_table()
    assert [row["scale"] for row in rows] == list(scale.BUDGETS)
    assert json.dumps(rows)


# stored results


def test_result_is_computed_once_and_loaded_afterwards(results):
    compute = Computation()
    first = reproduction_results.result("x", compute, AGENT, starts=2)
    second = reproduction_results.result("x", compute, AGENT, starts=2)
    assert compute.calls == 1
    assert first == second
    assert list(json.loads((results / "x.json").read_text())) == ["parts"]
    source = {"name": "a", "hash": "1234", "states_hash": "56", "steps": 7}
    assert first["provenance"]["agent"] == source


@pytest.mark.parametrize(
    "agent, setting, difference",
    [
        (AGENT, {"starts": 3}, "starts is 2 there and 3 here"),
        (AGENT, {"starts": 2, "seed": 1}, "seed is None there and 1 here"),
        (Known("5678"), {"starts": 2}, "its agent's hash is '1234' there and '5678' here"),
        (Known("1234", "57"), {"starts": 2}, "its agent's states_hash is '56' there and '57'"),
    ],
)
def test_a_file_of_another_agent_or_setting_is_overwritten_on_request_only(
    results, agent, setting, difference
):
    compute, path = Computation(), results / "x.json"
    reproduction_results.result("x", compute, AGENT, starts=2)
    before = path.read_bytes()
    with pytest.raises(ValueError, match=f"x.json .*{difference}.*recompute=True"):
        reproduction_results.result("x", compute, agent, **setting)
    assert compute.calls == 1 and path.read_bytes() == before
    assert reproduction_results.stored_parts("x", agent, **setting) == []
    reproduction_results.result("x", compute, agent, recompute=True, **setting)
    again = reproduction_results.result("x", compute, agent, **setting)
    assert compute.calls == 2 and again["records"] == [{"call": 2}]
    assert again["provenance"]["agent"]["hash"] == agent.hash
    assert [path.name for path in results.iterdir()] == ["x.json"]


def test_full_scale_has_its_own_file(results, monkeypatch):
    monkeypatch.setenv("SHAPEBODY_SCALE", "full")
    reproduction_results.result("x", Computation(), AGENT)
    assert [path.name for path in results.iterdir()] == ["x_full.json"]


def test_smoke_scale_neither_reads_nor_writes(results, monkeypatch):
    compute = Computation()
    reproduction_results.result("x", compute, AGENT)
    monkeypatch.setenv("SHAPEBODY_SCALE", "smoke")
    before = (results / "x.json").read_text()
    assert reproduction_results.result("x", compute, AGENT)["records"] == [{"call": 2}]
    reproduction_results.result("y", compute, AGENT)
    assert (results / "x.json").read_text() == before
    assert [path.name for path in results.iterdir()] == ["x.json"]


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "{}", '{"parts": {"all": {"provenance": {"config": {}}}}}', '{"parts": 1}'],
)
def test_damaged_file_is_reported_and_can_be_recomputed(results, text):
    results.mkdir()
    (results / "x.json").write_text(text)
    with pytest.raises(ValueError, match="x.json.*damaged.*recompute=True"):
        reproduction_results.result("x", Computation(), AGENT)
    assert reproduction_results.result("x", Computation(), AGENT, recompute=True)["records"]


def test_interrupted_computation_leaves_the_file_as_it_was(results):
    reproduction_results.result("x", Computation(), AGENT)
    before = (results / "x.json").read_text()

    def interrupted():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reproduction_results.result("x", interrupted, AGENT, recompute=True)
    assert (results / "x.json").read_text() == before


def test_parts_are_stored_one_by_one_and_an_interruption_keeps_them(results):
    one, two = Computation(), Computation()

    def interrupted():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reproduction_results.result_in_parts("x", {"one": one, "two": interrupted}, AGENT, starts=2)
    stored = reproduction_results.result_in_parts("x", {"one": one, "two": two}, AGENT, starts=2)
    assert (one.calls, two.calls) == (1, 1)
    assert stored["records"] == [{"call": 1}, {"call": 1}]
    # Another selection, in another order, is read from the same file.
    three = {"three": Computation(), "one": one}
    assert len(reproduction_results.result_in_parts("x", three, AGENT, starts=2)["records"]) == 2
    assert list(json.loads((results / "x.json").read_text())["parts"]) == ["one", "two", "three"]
    assert one.calls == 1
    # Anew, a part takes the place of its old records; the others stay.
    again = reproduction_results.result_in_parts("x", {"one": one}, AGENT, recompute=True, starts=2)
    assert again["records"] == [{"call": 2}] and (one.calls, two.calls) == (2, 1)
    assert list(json.loads((results / "x.json").read_text())["parts"]) == ["one", "two", "three"]
    # With other settings, the whole file is replaced.
    reproduction_results.result_in_parts("x", {"one": one}, AGENT, recompute=True, starts=3)
    assert list(json.loads((results / "x.json").read_text())["parts"]) == ["one"]


def test_a_part_of_other_settings_of_its_own_is_refused(results):
    one, two = Computation(), Computation()
    parts = {"one": one, "two": two}
    for _ in range(2):
        settings = {"one": {"rate": (1, 2)}}
        reproduction_results.result_in_parts("x", parts, AGENT, settings=settings)
    assert (one.calls, two.calls) == (1, 1)
    settings = {"one": {"rate": 3}}
    with pytest.raises(ValueError, match=r"'one' in .*: rate is \[1, 2\] there and 3 here; delete"):
        reproduction_results.result_in_parts("x", parts, AGENT, settings=settings)
    assert reproduction_results.stored_parts("x", AGENT, settings) == ["two"]
    reproduction_results.result_in_parts(
        "x", {"one": one}, AGENT, recompute=True, settings=settings
    )
    assert (one.calls, two.calls) == (2, 1)
    stored = json.loads((results / "x.json").read_text())["parts"]
    assert stored["one"]["provenance"]["settings"] == {"rate": 3}
    assert reproduction_results.stored_parts("x", AGENT, settings) == ["one", "two"]
    assert reproduction_results.stored_parts("x", AGENT, {"one": {"rate": 4}}) == ["two"]


def test_another_process_of_another_agent_is_not_overwritten(results):
    def meanwhile():
        reproduction_results.result("x", Computation(), Known("5678"))
        return [{"a": 1}]

    with pytest.raises(ValueError, match="x.json is of another result"):
        reproduction_results.result("x", meanwhile, AGENT)
    assert reproduction_results.stored_parts("x", Known("5678")) == ["all"]


def test_a_table_has_a_row_per_record(results):
    study = reproduction_results.result("x", lambda: synthetic(), AGENT)
    table = reproduction_results.frame(study)
    assert len(table) == len(study["records"]) and list(table) == list(study["records"][0])
    vgds = table.query("method == 'vgds' and trust_region == 20 and origin == 'start'")
    assert vgds["return"].tolist() == [7.0, 9.0, 8.0]
    assert table[table["method"] == "penalty-only"]["trust_region"].isna().all()
    assert reproduction_results.frame(table) is table
    assert reproduction_results.frame(study["records"]).equals(table)
    assert gains.gains(table).equals(gains.gains(study["records"]))


# gains


def record(origin, start, method, trust_region, value, **more):
    keys = dict(origin=origin, start=start, method=method, trust_region=trust_region)
    returns = [value - 1, value + 1]
    return {**keys, "return": value, "returns": returns, "tracking_error": 1 / value, **more}


def synthetic(vgds=(7.0, 9.0, 8.0), penalty=(6.0, 7.5, 7.0)):
    initial = (1.0, 2.0, 3.0)
    records = [record("start", i, "none", None, x) for i, x in enumerate(initial)]
    records += [record("start", i, "vgds", 20.0, x) for i, x in enumerate(vgds)]
    # The order of records must not matter.
    records += [record("start", i, "penalty-only", None, x) for i, x in enumerate(penalty)][::-1]
    records.append(record("reference", None, "none", None, 5.0))
    return records + [record("reference", None, "vgds", 20.0, 5.5, returns=[4.6, 6.4])]


def test_gains_are_paired_by_start():
    rows = gains.gains(synthetic())
    one = gains.gain(rows, "vgds", "penalty-only", 20.0)
    assert one["mean"] == pytest.approx((1 + 1.5 + 1) / 3)
    assert 1 <= one["low"] <= one["mean"] <= one["high"] <= 1.5
    assert (one["pairs"], one["positive"]) == (3, 3)
    assert gains.gain(rows, "vgds", "start", 20.0)["mean"] == pytest.approx(6)
    assert gains.gain(rows, "penalty-only", "start")["mean"] == pytest.approx(29 / 6)
    reference = gains.gain(rows, "reference", "start")
    assert (reference["mean"], reference["positive"]) == (pytest.approx(3), 3)
    own = gains.gain(rows, "vgds", "reference", 20.0)
    assert (own["mean"], own["low"], own["high"]) == pytest.approx((0.5, 0.4, 0.6))
    assert (own["pairs"], own["positive"]) == (2, 2)
    errors = gains.gains(synthetic(), "tracking_error")
    reduced = gains.gain(errors, "penalty-only", "start")["mean"]
    assert reduced == pytest.approx(np.mean([1 / 6 - 1, 1 / 7.5 - 1 / 2, 1 / 7 - 1 / 3]))


def test_gains_of_incomplete_records():
    with pytest.raises(ValueError, match="both need the same"):
        gains.gains(synthetic(penalty=(6.0, 7.5)))
    with pytest.raises(ValueError, match="0 evaluations of the reference"):
        gains.gains(synthetic()[:9])
    with pytest.raises(ValueError, match="no gain of vgds over start at 5"):
        gains.gain(gains.gains(synthetic()), "vgds", "start", 5.0)


@pytest.mark.parametrize(
    "low, high, word", [(0.1, 1, "positive"), (-1, -0.1, "negative"), (-1, 1, "not settled")]
)
def test_verdict(low, high, word):
    assert statistics.verdict(low, high).startswith(word)


def test_rank_correlation_agrees_with_scipy():
    from scipy.stats import spearmanr

    generator = np.random.default_rng(0)
    x = generator.normal(size=60)
    y = np.round(x + generator.normal(size=60), 1)  # with ties
    rho, low, high = statistics.rank_correlation(x, y)
    assert rho == pytest.approx(spearmanr(x, y).statistic)
    assert low < rho < high
    # The resamples of before, with which notebooks and stored results were made.
    assert (low, high) == pytest.approx((0.40836090202, 0.74857323868), abs=1e-9)
    assert statistics.rank_correlation(x, np.exp(x))[0] == pytest.approx(1)
    assert np.isnan(statistics.rank_correlation(x, np.ones(60))[0])
    with pytest.raises(ValueError, match="three or more"):
        statistics.rank_correlation([1, 2], [1, 2])
