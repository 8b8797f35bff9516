"""Sentences of the notebooks that state a finding, against the records that they rest on.

`CLAIMS` has a row per sentence: the notebook, the sentence with its numbers as computed here from
data/results, and whether what it says in words holds. A sentence that is no longer in its notebook,
or no longer true, fails.
"""

import functools
import json
from pathlib import Path

import numpy as np
import pytest

from shapebody.agent.store import load_agent
from shapebody.evaluation.statistics import paired_gain, rank_correlation
from shapebody.files import data_dir
from shapebody.reproduction import critic_ablation, gains, paper, results

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
GO2, HUMANOID, GOLEM = paper.ROBOTS


@functools.cache
def text(notebook: str) -> str:
    """The prose of a notebook on one line."""
    (path,) = NOTEBOOKS.glob(f"{notebook}_*.ipynb")
    cells = json.loads(path.read_text())["cells"]
    prose = ["".join(c["source"]) for c in cells if c["cell_type"] == "markdown"]
    return " ".join(" ".join(prose).split())


@functools.cache
def records(name: str) -> list[dict]:
    return results.stored_result(data_dir() / "results" / f"{name}.json")["records"]


def interval(low, high, mean=None, digits=1) -> str:
    """As the notebooks print gains: "+6.3 [+5.0, +7.5]"."""
    bounds = f"[{low:+.{digits}f}, {high:+.{digits}f}]"
    return bounds if mean is None else f"{mean:+.{digits}f} {bounds}"


@functools.cache
def tasks(name: str, trust_region: float):
    """Return with the critic of the evaluation's task minus that with the training's, paired."""
    newer, older = (
        [
            r["returns"]
            for r in records(f"critic_tasks_{name}")
            if "returns" in r and (r["critic"], r["trust_region"]) == (kind, trust_region)
        ]
        for kind in ("task of the evaluation", "task of the training")
    )
    return paired_gain(newer, older)


@functools.cache
def over_penalty(name: str) -> dict:
    """Gains of the two critics over penalty only, by critic and λ."""
    found = [r for r in records(f"critic_tasks_{name}") if "returns" in r]
    return {(r["critic"], r["trust_region"]): r for r in critic_ablation.critic_gains(found)}


def gained(name: str, over: str, method: str = "vgds"):
    """Gain in the design study at λ = 100."""
    row = gains.gain(gains.gains(records(f"design_study_{name}")), method, over, 100.0)
    return row["low"], row["high"], row["mean"]


def rho(name: str):
    pairs = records(f"value_against_return_{name}")
    return rank_correlation([r["predicted_value"] for r in pairs], [r["return"] for r in pairs])


def authors(name: str):
    """Gain of the reference over the starts with the authors' policy, and its reference's return"""
    first, *starts = records(f"published_policy_{name}")
    starts = np.array([record["returns"] for record in starts])
    return paired_gain(np.broadcast_to(first["returns"], starts.shape), starts), first["return"]


def own_reference(name: str) -> float:
    study = records(f"design_study_{name}")
    return next(r["return"] for r in study if (r["origin"], r["method"]) == ("reference", "none"))


def printed(name: str) -> float:
    return paper.SINGLE_ROBOT[name]["f_ref"]


def shown(gain) -> str:
    return interval(gain.low, gain.high, gain.mean)


def sizes(critic: str):
    return over_penalty(GO2)[f"task of the {critic}", 100.0]["size"]


def claims():
    """(notebook, sentence, whether it is true)."""
    go2, humanoid, golem = (
        {value: tasks(name, value) for value in (20.0, 100.0)} for name in paper.ROBOTS
    )
    yield "06", f"the Go2's bodies earn {shown(go2[20.0])} more at λ = 20", go2[20.0].low > 0
    yield "06", f"and {shown(go2[100.0])} at λ = 100", go2[100.0].low < 0 < go2[100.0].high
    yield (
        "06",
        "before, all three sizes shrank, now only the height does",
        max(sizes("training")) < 0 and min(sizes("evaluation")[:2]) > -0.01,
    )
    yield (
        "06",
        f"The MIT Humanoid's earn {shown(humanoid[100.0])} more at λ = 100 and "
        f"{shown(humanoid[20.0])} at λ = 20, where the critic makes the robot worse than penalty "
        "only does",
        humanoid[100.0].low > 0
        and over_penalty(HUMANOID)["task of the evaluation", 20.0]["high"] < 0,
    )
    yield (
        "06",
        f"The Golem's earn {shown(golem[20.0])} more at λ = 20 and {shown(golem[100.0])} at "
        "λ = 100",
        golem[20.0].low > 0 and golem[100.0].low > 0,
    )
    yield "06", f"the critic {interval(*gained(GO2, 'penalty-only'))}, on 10 of 10 starts", True
    one, other = rho(GO2), rho(HUMANOID)
    yield (
        "06",
        f"ρ is {one[0]:.2f} [{one[1]:.2f}, {one[2]:.2f}] and "
        f"{other[0]:.2f} [{other[1]:.2f}, {other[2]:.2f}]",
        one[1] > other[2],
    )
    both = [authors(name) for name in paper.ROBOTS]
    yield (
        "03",
        f"the Go2's policy returns {both[0][1]:.1f} and the MIT Humanoid's {both[1][1]:.1f}",
        both[0][1] > own_reference(GO2) and both[1][1] > own_reference(HUMANOID),
    )
    for name, (gain, _) in zip((GO2, HUMANOID), both[:2], strict=True):
        bounds = interval(gain.low, gain.high)
        yield "03", bounds, gain.low < printed(name) < gain.high
    yield (
        "03",
        "for the Golem the paper's number is above our interval",
        printed(GOLEM) > both[2][0].high,
    )


@pytest.mark.parametrize("notebook, sentence, holds", list(claims()))
def test_what_a_notebook_states(notebook, sentence, holds):
    assert sentence in text(notebook), f"notebook {notebook} should say: {sentence}"
    assert holds, f"not true any more: {sentence}"


def test_results_of_the_critics_belong_to_the_shipped_agents():
    for name in paper.ROBOTS:
        file = data_dir() / "results" / f"critic_tasks_{name}.json"
        source = results.stored_result(file)["provenance"]["agent"]
        assert source["hash"] == load_agent(name).hash
