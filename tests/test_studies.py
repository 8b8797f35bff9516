"""Design studies: searches, their evaluation, and the file that keeps both."""

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image
from test_networks import published_layers, write_published

from shapebody.agent.store import load_agent
from shapebody.design.space import DesignSpace
from shapebody.evaluation.evaluate import EvaluationConfig, evaluate
from shapebody.evaluation.statistics import paired_gain
from shapebody.files import data_dir
from shapebody.optimizers.objective import Objective
from shapebody.optimizers.search import METHODS, search
from shapebody.reproduction import design_study as reproduction_design_study
from shapebody.reproduction import gains as reproduction_gains
from shapebody.reproduction import paper, value_studies
from shapebody.reproduction import results as reproduction_results
from shapebody.reproduction import scale as reproduction_scale
from shapebody.reproduction.design_study import (
    PENALTY_ONLY,
    Run,
    available,
    design_study,
    installed,
)
from shapebody.robot.robot import load_robot
from shapebody.task.config import TaskConfig
from tools import studies

RUNS = (PENALTY_ONLY, Run("vgds", 20.0), Run("cem"), Run("vgds", 100.0, "reference"))
SETTING = dict(starts=2, episodes=3, horizon=12, iterations=2)


pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture
def results(tmp_path, monkeypatch):
    monkeypatch.setenv("SHAPEBODY_DATA", str(tmp_path))
    monkeypatch.setenv("SHAPEBODY_SCALE", "reduced")
    return tmp_path / "results"


def test_runs_are_the_papers():
    lambdas = [
        run.trust_region
        for run in reproduction_design_study.TRUST_REGION_RUNS
        if run.method == "vgds"
    ]
    assert lambdas == list(paper.LAMBDAS)
    assert {run.method for run in reproduction_design_study.METHOD_RUNS} == set(METHODS)
    assert {run.trust_region for run in reproduction_design_study.METHOD_RUNS} == {None, 100.0}
    assert (
        PENALTY_ONLY in reproduction_design_study.METHOD_RUNS
        and PENALTY_ONLY in reproduction_design_study.TRUST_REGION_RUNS
    )
    assert installed(RUNS[:3]) == RUNS[:3]


def test_records_are_what_search_and_evaluation_give(results, agent, robot):
    study = design_study(agent, robot, RUNS, **SETTING)
    records = study["records"]
    assert [(r["method"], r["origin"], r["start"]) for r in records] == [
        ("none", "start", 0),
        ("none", "start", 1),
        ("none", "reference", None),
        ("penalty-only", "start", 0),
        ("penalty-only", "start", 1),
        ("vgds", "start", 0),
        ("vgds", "start", 1),
        ("cem", "start", 0),
        ("cem", "start", 1),
        ("vgds", "reference", None),
    ]
    assert study["provenance"]["agent"]["hash"] == agent.hash
    (path,) = results.glob("design_study_*.json")
    parts = json.loads(path.read_text())["parts"]
    settings = parts["cem, lambda 100, from the starts"]["provenance"]["settings"]
    assert settings == dataclasses.asdict(METHODS["cem"].config(iterations=2))

    space = DesignSpace(robot)
    starts = np.stack([space.start(0), space.start(1)])
    found = search("vgds", agent, robot, starts, trust_region=20.0, iterations=2)
    task = TaskConfig.evaluation(horizon=12)
    score = evaluate(agent, robot, found.design, config=EvaluationConfig(episodes=3, task=task))
    for i, record in enumerate(records[5:7]):
        np.testing.assert_allclose(record["returns"], score.returns[i], atol=6e-4)
        assert record["return"] == pytest.approx(score.mean[i], abs=1e-4)
        assert record["tracking_error"] == pytest.approx(score.mean_tracking_error[i], abs=1e-5)
        value = Objective.of(agent, robot, 0.0).value(found.design[i])
        assert record["predicted_value"] == pytest.approx(float(value), abs=1e-4)
        assert record["evaluations"] == found.evaluations == 2
        assert record["curve_evaluations"] == [0, 1, 2]
        assert record["curve_objective"][-1] == pytest.approx(found.objective[i], abs=2e-4)
    # The same episodes for all designs.
    rows = reproduction_gains.gains(records)
    own = reproduction_gains.gain(rows, "vgds", "reference", 100.0)
    assert own["pairs"] == 3
    assert reproduction_gains.gain(rows, "cem", "penalty-only", 100.0)["pairs"] == 2


@pytest.mark.skipif(not installed((Run("bo"),)), reason="BoTorch is not installed")
def test_evaluations_along_the_curve_of_bo(results, agent, robot):
    """BO has scored its first points before its first iteration."""
    records = design_study(agent, robot, (Run("bo"),), **dict(SETTING, starts=1))["records"]
    first = METHODS["bo"].config().initial_points
    assert records[-1]["evaluations"] == first + 2
    assert records[-1]["curve_evaluations"] == [0, first + 1, first + 2]


def test_what_is_stored_is_not_computed_again(results, agent, robot, monkeypatch):
    first = design_study(agent, robot, RUNS[:2], **SETTING)
    searched = []

    def spy(method, *arguments, **options):
        searched.append(method)
        return search(method, *arguments, **options)

    monkeypatch.setattr(reproduction_design_study, "search", spy)
    second = design_study(agent, robot, RUNS[:3], **SETTING)
    assert searched == ["cem"]
    assert second["records"][:7] == first["records"]
    (path,) = results.iterdir()
    assert path.name == f"design_study_{robot.name}_{robot.hash}.json"
    assert len(json.loads(path.read_text())["parts"]) == 4
    design_study(agent, robot, RUNS[:1], recompute=True, **SETTING)
    assert searched == ["cem", "penalty-only"]
    assert len(json.loads(path.read_text())["parts"]) == 4


def test_a_study_of_more_episodes_is_used_and_completed_with_as_many(results, agent, robot):
    first = design_study(agent, robot, RUNS[:1], **SETTING)
    fewer = dict(SETTING, episodes=2)
    both = design_study(agent, robot, RUNS[:2], **fewer)
    assert both["records"][:5] == first["records"]
    assert {len(record["returns"]) for record in both["records"]} == {3}
    again = design_study(agent, robot, RUNS[:1], recompute=True, **fewer)
    assert again["records"][0]["returns"] == first["records"][0]["returns"]
    stored = results / f"design_study_{robot.name}_{robot.hash}.json"
    # More episodes than stored, or other starts, are another study.
    for other in (dict(SETTING, episodes=4), dict(fewer, starts=1)):
        with pytest.raises(ValueError, match="(episodes|starts) is . there and . here"):
            design_study(agent, robot, RUNS[:1], **other)
    more = dict(SETTING, episodes=4)
    more = design_study(agent, robot, RUNS[:1], recompute=True, **more)
    assert {len(record["returns"]) for record in more["records"]} == {4}
    assert [path.name for path in results.iterdir()] == [stored.name]


def test_other_starts_have_their_own_file(results, agent, robot):
    runs = (PENALTY_ONLY, Run("vgds", 20.0))
    own = design_study(agent, robot, runs, **dict(SETTING, starts=3))["records"]
    path = results / f"design_study_{robot.name}_{robot.hash}.json"
    before = path.read_bytes()
    other = design_study(agent, robot, runs, first_start=2, **dict(SETTING, starts=1))["records"]
    assert [r["start"] for r in other] == [2, None, 2, 2]
    assert path.read_bytes() == before
    (mine,) = results.glob("*_starts_from_2.json")
    stored = json.loads(mine.read_text())
    assert all(
        part["provenance"]["config"]["first_start"] == 2 for part in stored["parts"].values()
    )
    # The same start, searched and evaluated in another batch.
    same = [r for r in own if r["start"] == 2]
    for mine, one in zip(same, (other[0], *other[2:]), strict=True):
        assert (mine["method"], mine["trust_region"]) == (one["method"], one["trust_region"])
        assert mine["predicted_value"] == pytest.approx(one["predicted_value"], abs=1e-3)
    assert (
        reproduction_gains.gain(reproduction_gains.gains(other), "vgds", "penalty-only", 20.0)[
            "pairs"
        ]
        == 1
    )
    with pytest.raises(ValueError, match="first_start is -1; expected an integer of at least 0"):
        design_study(agent, robot, runs, first_start=-1, **SETTING)


@pytest.mark.parametrize(
    "run, message",
    [
        (Run("adam"), "unknown method in .*'adam'.* known: vgds, penalty-only, random"),
        (Run("vgds", None), "trust_region of vgds is None"),
        (Run("vgds", -1.0), "trust_region of vgds is -1.0.* at least 0"),
        (Run("penalty-only", 20.0), "expected None"),
        (Run("vgds", 20.0, "refrence"), "origin of a run is 'refrence'"),
    ],
)
def test_a_run_that_cannot_be_stops_before_the_first(results, agent, robot, run, message):
    with pytest.raises(ValueError, match=message):
        design_study(agent, robot, (PENALTY_ONLY, run), **SETTING)
    with pytest.raises(ValueError, match="starts is 0; expected an integer of at least 1"):
        design_study(agent, robot, RUNS, **dict(SETTING, starts=0))
    with pytest.raises(ValueError, match="iterations is 0; expected an integer of at least 1"):
        design_study(agent, robot, RUNS, **dict(SETTING, iterations=0))
    assert not results.exists()


def test_a_robot_file_that_was_changed_has_its_own_study(results, agent, robot):
    folder = results.parent / "robots"
    folder.mkdir()
    (folder / f"{robot.name}.xml").write_text(robot.xml)
    design_study(agent, robot, RUNS[:1], **SETTING)
    shipped = results / f"design_study_{robot.name}.json"
    before = shipped.read_bytes()
    other = dataclasses.replace(robot, xml=robot.xml + "<!-- another -->")
    design_study(agent, other, RUNS[:1], **SETTING)
    assert shipped.read_bytes() == before
    assert (results / f"design_study_{robot.name}_{other.hash}.json").exists()


def test_gains_refuse_two_engines(results, agent, robot):
    records = design_study(agent, robot, RUNS[:1], **SETTING)["records"]
    records[-1]["engine"] = "mjx"
    with pytest.raises(ValueError, match="engines mjx, native"):
        reproduction_gains.gains(records)


def test_available_runs_are_installed_or_stored(results, agent, robot, monkeypatch):
    runs = (PENALTY_ONLY, Run("bo"), Run("vgds", 20.0))
    monkeypatch.setattr(
        reproduction_design_study,
        "installed",
        lambda runs: tuple(run for run in runs if run.method != "bo"),
    )
    assert available(agent, robot, runs, **SETTING) == runs[::2]
    monkeypatch.setattr(
        reproduction_design_study,
        "search",
        lambda method, *rest, **options: search("random", *rest, **options),
    )
    design_study(agent, robot, runs[1:2], **SETTING)
    assert available(agent, robot, runs, **SETTING) == runs
    assert available(agent, robot, runs, **dict(SETTING, episodes=2)) == runs
    for other in (dict(SETTING, starts=3), dict(SETTING, recompute=True)):
        assert available(agent, robot, runs, **other) == runs[::2]
    monkeypatch.setenv("SHAPEBODY_SCALE", "smoke")
    assert available(agent, robot, runs, **SETTING) == runs[::2]


def interval(gain, digits=1):
    return "{:+.{d}f} [{:+.{d}f}, {:+.{d}f}]".format(*gain, d=digits)


def numbers(gain):
    return gain["mean"], gain["low"], gain["high"]


def readme_rows(name):
    """The rows of README's two tables for one robot, from data/results, and their episodes."""
    robot, agent = load_robot(name), load_agent(name)

    def stored(file):
        study = reproduction_results.stored_result(data_dir() / "results" / f"{file}_{name}.json")
        assert study["provenance"]["agent"]["hash"] == agent.hash, f"{file}: another agent"
        return study["records"]

    def returns(records, method, origin):
        found = [r for r in records if (r["method"], r["origin"]) == (method, origin)]
        return np.array([r["returns"] for r in found])

    records = stored("design_study")
    others = reproduction_results.stored_result(
        data_dir() / "results" / f"design_study_{name}_starts_from_10.json"
    )["records"]
    gains = {
        q: reproduction_gains.gains(records, q) for q in ("return", "tracking_error", "length")
    }
    plain = [
        paired_gain(values, np.zeros_like(values))
        for values in (returns(records, "none", "reference")[0], returns(records, "none", "start"))
    ]
    added = {q: reproduction_gains.gain(gains[q], "vgds", "penalty-only", 100.0) for q in gains}
    again = reproduction_gains.gain(reproduction_gains.gains(others), "vgds", "penalty-only", 100.0)
    first = [
        robot.display_name,
        f"{agent.metadata['steps'] / 1e6:.1f} million",
        *(f"{one.mean:.1f} [{one.low:.1f}, {one.high:.1f}]" for one in plain),
        f"{paper.SINGLE_ROBOT[name]['VGDS']:+.1f}",
        interval(numbers(reproduction_gains.gain(gains["return"], "vgds", "start", 100.0))),
        interval(numbers(added["return"])),
        interval(numbers(again)),
    ]
    apart = stored("size_share")
    base = next(np.array(r["returns"]) for r in apart if r["kept"] == "reference")
    parts = {}
    for kept in ("all", "size only", "all but size"):
        mine = np.array([r["returns"] for r in apart if r["kept"] == kept])
        parts[kept] = paired_gain(mine, np.broadcast_to(base, mine.shape))
    second = [
        robot.display_name,
        interval(numbers(added["tracking_error"]), 3),
        interval(numbers(added["length"]), 0),
        *(interval(gain[:3]) for gain in parts.values()),
    ]
    episodes = [len(some[0]["returns"]) for some in (records, others, apart)]
    return f"| {' | '.join(first)} |", f"| {' | '.join(second)} |", episodes, added, parts


def yardstick_row(name: str) -> str:
    path = data_dir() / "results" / f"yardstick_{name}.json"
    success = {
        (record["policy"], record["coefficient"]): f"{np.mean(record['success']):.0%}"
        for record in reproduction_results.stored_result(path)["records"]
    }
    ours, theirs = (
        f"{success[policy, 1.0]} and {success[policy, 0.5]}".replace("%", " %")
        for policy in ("shipped", "published")
    )
    label = "success on 256 random bodies, c = 1 and 0.5"
    return f"| {label} | {ours} (the authors' policy: {theirs}) |"


def test_readme_states_the_stored_results():
    """The tables of agents, row by row, from data/results, and the sentences that go with them."""
    readme = (Path(__file__).parents[1] / "README.md").read_text()
    text = " ".join(readme.split())
    added, parts, names = {}, {}, reproduction_scale.trained_robots(paper.ROBOTS)
    for name in names:
        first, second, episodes, added[name], parts[name] = readme_rows(name)
        for row in (first, second):
            assert row in readme, f"README.md should have: {row}"
        assert episodes[1:] == [50, episodes[0]]
        card = (data_dir() / "checkpoints" / name / "README.md").read_text()
        cells = [row.strip("| ").split(" | ") for row in (first, second)]
        for cell in (*cells[0][1:], *cells[1][3:5]):
            assert cell in card, f"the card of {name} should have: {cell}"
        assert f"{episodes[0]} episodes a body" in card
        assert yardstick_row(name) in card, f"the card of {name} should have: {yardstick_row(name)}"
        assert f"{episodes[0]} for the {load_robot(name).display_name}" in text

    go2, golem = (added[name] for name in ("unitree_go2", "golem"))
    assert "The Go2s that are found track better and last longer" in text
    assert go2["tracking_error"]["high"] < 0 < go2["length"]["low"]
    assert "most of their gain over the reference is the size of the body" in text
    assert parts["unitree_go2"]["size only"].low > parts["unitree_go2"]["all but size"].high
    assert "The Golems track no better and last no longer" in text
    assert golem["tracking_error"]["high"] > 0 and golem["length"]["high"] < 1
    assert "their size alone gains nothing" in text
    alone = parts["golem"]["size only"]
    assert alone.low < 0 < alone.high

    assert "at λ = 0, VGDS makes the MIT Humanoid and the Golem worse than penalty only" in text
    for name in ("mit_humanoid", "golem"):
        path = data_dir() / "results" / f"design_study_{name}.json"
        rows = reproduction_gains.gains(reproduction_results.stored_result(path)["records"])
        assert reproduction_gains.gain(rows, "vgds", "penalty-only", 0.0)["high"] < 0


def test_readme_states_the_example_and_the_mean():
    """The caption of its picture: one start, and the ten."""
    text = " ".join((Path(__file__).parents[1] / "README.md").read_text().split())
    path = data_dir() / "results" / "design_study_unitree_go2.json"
    found = {}
    for record in reproduction_results.stored_result(path)["records"]:
        if record["origin"] == "start" and record["trust_region"] in (None, 100.0):
            found.setdefault(record["method"], {})[record["start"]] = record["return"]
    one = [found[method][3] for method in ("none", "vgds", "penalty-only")]
    ten = [np.mean(list(found[method].values())) for method in ("none", "vgds", "penalty-only")]
    for start, end, alone, words in (
        (*one, "{:.1f} to {:.1f} (penalty only: {:.1f})"),
        (*ten, "over ten random bodies from {:.1f} to {:.1f} ({:.1f})"),
    ):
        assert words.format(start, end, alone) in text


def test_stored_results_belong_to_the_shipped_agents():
    folder = data_dir() / "results"
    seen = set()
    for path in sorted(folder.glob("*.json")):
        for part in json.loads(path.read_text())["parts"].values():
            source = part["provenance"].get("agent")
            if source:
                assert source["hash"] == load_agent(source["name"]).hash, path.name
                seen.add(path.name)
    assert len(seen) >= 3 * len(reproduction_scale.trained_robots(paper.ROBOTS))
    with Image.open(folder / "before_after.png") as picture:
        source = json.loads(picture.text["provenance"])
    assert source["agent"]["hash"] == load_agent("unitree_go2").hash


@pytest.mark.parametrize(
    "name, episodes", [("unitree_go2", 100), ("mit_humanoid", 50), ("golem", 50)]
)
def test_stored_studies_are_whole(name, episodes):
    """All methods and all λ, with today's settings; the paper has 200 episodes."""
    robot, agent = load_robot(name), load_agent(name)
    runs = (*reproduction_design_study.METHOD_RUNS, *reproduction_design_study.TRUST_REGION_RUNS)
    setting = dict(starts=10, episodes=episodes, horizon=1000)
    assert available(agent, robot, runs, **setting) == runs
    stored = reproduction_results.stored_parts(
        f"design_study_{name}",
        agent,
        reproduction_design_study.search_settings(runs),
        **setting,
        seed=0,
    )
    assert {reproduction_design_study.part_name(run) for run in runs} <= set(stored)


def test_size_share_takes_the_found_designs_apart(agent, robot, monkeypatch):
    setting = dict(starts=2, episodes=2, horizon=12, iterations=3)
    walked = []

    def seen(agent, robot, designs, **rest):
        walked.append(designs)
        return evaluate(agent, robot, designs, **rest)

    monkeypatch.setattr(value_studies, "evaluate", seen)
    records = value_studies.size_share(agent, robot, **setting)
    kinds = ("all", "size only", "all but size")
    expected = [("reference", None), *((kind, i) for kind in kinds for i in range(2))]
    assert [(r["kept"], r["start"]) for r in records] == expected
    (designs,) = walked
    space = DesignSpace(robot)
    initial = np.stack([space.start(i) for i in range(2)])
    found = search("vgds", agent, robot, initial, trust_region=100.0, iterations=3).design
    reference, everything, size, rest = np.split(designs, [1, 3, 5])
    assert not reference.any()
    np.testing.assert_array_equal(everything, found)
    np.testing.assert_array_equal(size[:, :3], found[:, :3])
    np.testing.assert_array_equal(size + rest, found)
    assert not size[:, 3:].any() and not rest[:, :3].any()
    predicted = Objective.of(agent, robot, 0.0).value(designs)
    np.testing.assert_allclose([r["predicted_value"] for r in records], predicted, rtol=1e-5)
    assert all(len(r["returns"]) == 2 for r in records)


def test_published_policy(results, agent, robot, tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError, match="folder of the authors' weights"):
        value_studies.published_policy(robot, agent)
    write_published(tmp_path, published_layers(), robot.name)
    study = value_studies.published_policy(robot, agent, tmp_path, starts=1, episodes=2)
    assert [(r["origin"], r["start"]) for r in study["records"]] == [
        ("reference", None),
        ("start", 0),
    ]
    assert all(len(r["returns"]) == 2 for r in study["records"])
    for scale in ("reduced", "full", "smoke"):
        monkeypatch.setenv("SHAPEBODY_SCALE", scale)
        assert value_studies.published_policy(robot, agent) == study


def test_policies_are_measured_on_the_yardstick(results, agent, robot, tmp_path):
    first = value_studies.policy_yardstick(robot, agent, bodies=3)
    assert [(r["policy"], r["coefficient"]) for r in first["records"]] == [
        ("shipped", 1.0),
        ("shipped", 0.5),
    ]
    write_published(tmp_path, published_layers(), robot.name)
    both = value_studies.policy_yardstick(robot, agent, tmp_path, bodies=3)
    assert both["records"][:2] == first["records"]
    assert [r["policy"] for r in both["records"][2:]] == ["published", "published"]
    for record in both["records"]:
        assert set(record["success"]) <= {0, 1} and len(record["returns"]) == 3
    # Once stored, the published policy's records need no folder; another policy's are refused.
    assert value_studies.policy_yardstick(robot, agent, bodies=3) == both
    other = dataclasses.replace(agent, policy=jax.tree.map(lambda x: 2 * x, agent.policy))
    with pytest.raises(ValueError, match="other settings"):
        value_studies.policy_yardstick(robot, other, bodies=3)
    again = value_studies.policy_yardstick(robot, other, bodies=3, recompute=True)
    assert again["records"][2:] == both["records"][2:] and again["records"] != both["records"]


def test_a_study_is_stale_with_another_agent(results, agent, robot, monkeypatch, capsys):
    computed = []

    def study(of, parts=("one", "two")):
        def compute(recompute, stored):
            computed.append((of.hash, recompute))
            wanted = {part: (lambda: [{"x": 1}]) for part in parts}
            reproduction_results.result_in_parts("trial", wanted, of, recompute, **(stored or kept))

        return studies.Study("trial", ("one", "two"), None, of, compute)

    kept = {"starts": 3}
    other = dataclasses.replace(agent, policy=jax.tree.map(lambda x: 2 * x, agent.policy))
    assert study(agent).state() == "missing"
    study(agent, ("one",)).compute(False, {})
    assert study(agent).state() == "incomplete" and study(agent).stored() == kept
    monkeypatch.setattr(studies, "studies", lambda name: [study(agent)])
    for _ in range(2):  # the second time nothing is left
        studies.main(("some robot",))
    assert study(agent).state() == "current" and len(computed) == 2
    assert study(other).state() == "stale"
    monkeypatch.setattr(studies, "studies", lambda name: [study(other)])
    studies.main(("some robot",), list=True)
    assert "trial: stale" in capsys.readouterr().out and len(computed) == 2
    studies.main(("some robot",))
    assert computed[-1] == (other.hash, True) and study(other).state() == "current"
