"""Sentences of the notebooks that state a finding, against the records that they rest on.

A claim is a notebook, a sentence with its numbers as they are computed here from data/results (or
read from the notebook's own output, where there is no record), and whether what it says in words
holds. A sentence that is no longer in its notebook, or no longer true, fails.
"""

import functools
import json
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from shapebody.agent.store import load_agent, load_curve
from shapebody.evaluation.statistics import paired_gain, rank_correlation
from shapebody.files import data_dir
from shapebody.reproduction import critic_ablation, gains, paper, results

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
GO2, HUMANOID, GOLEM = paper.ROBOTS
GRADIENT_METHODS = ("vgds", "gc-pfo")
POLICIES = ("shipped", "published")


@functools.cache
def cells(notebook: str) -> list[dict]:
    (path,) = NOTEBOOKS.glob(f"{notebook}_*.ipynb")
    return json.loads(path.read_text())["cells"]


@functools.cache
def text(notebook: str) -> str:
    """The prose of a notebook on one line."""
    prose = ["".join(c["source"]) for c in cells(notebook) if c["cell_type"] == "markdown"]
    return " ".join(" ".join(prose).split())


def output(notebook: str, pattern: str) -> tuple[str, ...]:
    """The groups of a pattern in what a notebook printed."""
    outputs = [o for c in cells(notebook) for o in c.get("outputs", [])]
    told = ["".join(o.get("text") or o.get("data", {}).get("text/plain", "")) for o in outputs]
    found = re.search(pattern, "\n".join(told), re.MULTILINE)
    assert found, f"notebook {notebook} has no output like {pattern}"
    return found.groups()


@functools.cache
def stored(name: str) -> list[dict]:
    return results.stored_result(data_dir() / "results" / f"{name}.json")["records"]


@functools.cache
def records(name: str):
    return results.frame(stored(name))


def interval(gain, digits=1, mean=True) -> str:
    """As the notebooks print gains: "+6.3 [+5.0, +7.5]"."""
    bounds = f"[{gain.low:+.{digits}f}, {gain.high:+.{digits}f}]"
    return f"{gain.mean:+.{digits}f} {bounds}" if mean else bounds


def percent(share, digits=2) -> str:
    return f"{100 * share:.{digits}f} %"


# ------------------------------------------------------------------ numbers of the records


@functools.cache
def gain(study: str, over: str, trust_region: float | None = 100.0, method: str = "vgds"):
    """mean, low, high and positive of a gain in a design study."""
    row = gains.gain(gain_rows(study), method, over, trust_region)
    return SimpleNamespace(**{key: row[key] for key in ("mean", "low", "high", "positive")})


@functools.cache
def gain_rows(study: str):
    return gains.gains(records(f"design_study_{study}"))


def of(name: str, method: str, quantity: str = "return", trust_region: float = 100.0):
    """A quantity of the designs that a method found, one number (or row) per start."""
    rows = records(f"design_study_{name}").query("origin == 'start' and method == @method")
    rows = rows.query("trust_region == @trust_region") if method == "vgds" else rows
    return np.stack(rows.sort_values("start")[quantity].to_numpy())


def reference(name: str, quantity: str = "return"):
    rows = records(f"design_study_{name}").query("origin == 'reference' and method == 'none'")
    return rows[quantity].iloc[0]


def over_reference(name: str, trust_region: float = 100.0):
    reached = of(name, "vgds", "returns", trust_region)
    return paired_gain(reached, np.broadcast_to(reference(name, "returns"), reached.shape))


def fooled(name: str, trust_region: float) -> int:
    """Starts whose design the critic prefers to that of penalty only, and is wrong."""
    promised, walked = (
        of(name, "vgds", quantity, trust_region) - of(name, "penalty-only", quantity)
        for quantity in ("predicted_value", "return")
    )
    return int(((promised > 0) & (walked < 0)).sum())


def objective(name: str, method: str) -> float:
    return float(np.mean(of(name, method, "curve_objective")[:, -1]))


def methods(name: str) -> list[str]:
    """All searches at λ = 100, penalty only among them."""
    rows = records(f"design_study_{name}").query("origin == 'start' and method != 'none'")
    return list(rows["method"].unique())


def samplers(name: str) -> dict:
    """Gain over penalty only of the methods without a gradient."""
    others = [m for m in methods(name) if m not in (*GRADIENT_METHODS, "penalty-only")]
    return {m: gain(name, "penalty-only", method=m) for m in others}


def order(name: str) -> float:
    """Rank correlation of the methods' ΔR, ours and the paper's."""
    theirs = {m.lower(): x for m, x in paper.SINGLE_ROBOT[name].items() if m != "f_ref"}
    ours = [gain(name, "start", method=m).mean for m in theirs]
    return rank_correlation(list(theirs.values()), ours)[0]


def size_share(name: str) -> dict:
    """Gain over the reference of the parts of found designs."""
    rows = records(f"size_share_{name}")
    base = rows.query("kept == 'reference'")["returns"].iloc[0]
    parts = {part: np.stack(x["returns"].to_numpy()) for part, x in rows.groupby("kept")}
    del parts["reference"]
    return {part: paired_gain(x, np.broadcast_to(base, x.shape)) for part, x in parts.items()}


def authors(name: str):
    """Gain of the reference over the starts with the authors' policy, and its reference's return"""
    first, *starts = stored(f"published_policy_{name}")
    starts = np.array([record["returns"] for record in starts])
    return paired_gain(np.broadcast_to(first["returns"], starts.shape), starts), first["return"]


def rho(name: str):
    pairs = records(f"value_against_return_{name}")
    return rank_correlation(list(pairs["predicted_value"]), list(pairs["return"]))


@functools.cache
def critics(name: str) -> dict:
    """Gains of the two critics over penalty only, by critic and λ."""
    rows = [r for r in stored(f"critic_tasks_{name}") if "returns" in r]
    return {(r["critic"], r["trust_region"]): r for r in critic_ablation.critic_gains(rows)}


def tasks(name: str, trust_region: float):
    """Return with the critic of the evaluation's task minus that with the training's, paired."""
    newer, older = (
        [
            r["returns"]
            for r in stored(f"critic_tasks_{name}")
            if "returns" in r
            and (r["critic"], r["trust_region"]) == (f"task of the {task}", trust_region)
        ]
        for task in ("evaluation", "training")
    )
    return paired_gain(newer, older)


# ------------------------------------------------------------------ claims, a function per part


def robots_and_training():
    toppled = records("random_bodies").set_index("name")["toppled_holding"]
    claim = f"Of the MIT Humanoid's, {percent(toppled[HUMANOID], 0)} topple while they hold their"
    claim += " pose; six legs help, and of the Custom Hexapod's none does"
    yield "02", claim, toppled["custom_hexapod"] == 0
    pushes, noise = (output("03", rf"^no {x} .* m/s, (.*)$")[0] for x in ("pushes", "noise"))
    yield "03", f"without them the return is higher by {pushes}; without noise by {noise}", True
    theirs = {name: authors(name) for name in paper.ROBOTS}
    claim = f"the Go2's policy returns {theirs[GO2][1]:.1f} and the MIT Humanoid's "
    better = all(theirs[name][1] > reference(name) for name in (GO2, HUMANOID))
    yield "03", f"{claim}{theirs[HUMANOID][1]:.1f}", better
    printed = {name: paper.SINGLE_ROBOT[name]["f_ref"] for name in paper.ROBOTS}
    for name in (GO2, HUMANOID):
        one = theirs[name][0]
        yield "03", interval(one, mean=False), one.low < printed[name] < one.high
    claim = "for the Golem the paper's number is above our interval"
    yield "03", claim, printed[GOLEM] > theirs[GOLEM][0].high
    key, value, both = (
        float(output("04", rf"^gradient through {path}\s*: norm (\S+)$")[0])
        for path in ("key", "value", "key and value")
    )
    claim = f"{key:.2f} through the keys alone, {value:.2f} through the values alone and {both:.2f}"
    yield "04", claim, both > max(key, value)
    facts, whole = load_agent(GO2).metadata, paper.PPO["total_steps"]
    steps, more = facts["steps"], facts["steps"] + facts["policy_evaluation"]["steps"]
    c = np.nanmean(load_curve(GO2)["coefficient"][-5:])
    claim = f"The Go2's policy saw {steps / 1e6:.1f} million steps, {percent(steps / whole)} of the"
    yield "05", f"{claim} paper's, and stopped at c = {c:.2f}", 0.7 < c < 0.8
    claim = f"saw {percent(steps / whole)} of the paper's steps, and {percent(more / whole)} with"
    yield "05", claim, True
    walks = {(r["policy"], r["coefficient"]): r["success"] for r in stored(f"yardstick_{GO2}")}
    far, near = ([percent(np.mean(walks[p, c]), 0) for p in POLICIES] for c in (1.0, 0.5))
    claim = f"At c = 1 the shipped policy walks with {far[0]} of all bodies, the authors' policy "
    claim += f"with {far[1]}; at c = 0.5 it is {near[0]} and {near[1]}"
    yield "05", claim, np.mean(walks["shipped", 1.0]) < 0.5 < np.mean(walks["shipped", 0.5])


def value_gradient_design():
    whole, critic = gain(GO2, "start"), gain(GO2, "penalty-only")
    alone, again = gain(GO2, "start", None, "penalty-only"), gain(GO2, "reference")
    claim = (
        f"At λ = 100 VGDS gains {whole.mean:+.1f}, of which penalty only gives {alone.mean:+.1f}"
    )
    claim += f" and the critic {interval(critic)}, on 10 of 10 starts"
    yield "06", claim, critic.positive == 10
    yield "06", f"From the reference itself it gains {interval(again)}", again.low > 0
    claim = f"Of the Go2's {whole.mean:+.1f} over a random start, {alone.mean:+.1f} is the"
    yield "06", f"{claim} penalty's", True
    yield "06", f"evidence for the critic: {interval(critic)} here", critic.low > 0
    claim = f"VGDS gains {whole.mean:+.1f} in return, of which penalty only gives {alone.mean:+.1f}"
    yield "00", claim, alone.mean > whole.mean / 2
    claim = f"The critic adds {interval(critic)}, and it does so from all ten starts"
    yield "00", claim, critic.positive == 10
    one, other = rho(GO2), rho(HUMANOID)
    numbers = "{:.2f} [{:.2f}, {:.2f}]".format
    yield "06", f"ρ is {numbers(*one)} and {numbers(*other)}", one[1] > other[2]
    go2, humanoid, golem = (
        {value: tasks(name, value) for value in (20.0, 100.0)} for name in paper.ROBOTS
    )
    claim = f"the Go2's bodies earn {interval(go2[20.0])} more at λ = 20 and "
    claim += f"{interval(go2[100.0])} at λ = 100"
    yield "06", claim, go2[20.0].low > 0 and go2[100.0].low < 0 < go2[100.0].high
    before, now = (
        critics(GO2)[f"task of the {task}", 100.0]["size"] for task in ("training", "evaluation")
    )
    claim = "before, all three sizes shrank, now only the height does"
    yield "06", claim, max(before) < 0 and min(now[:2]) > -0.01
    claim = f"The MIT Humanoid's earn {interval(humanoid[100.0])} more at λ = 100 and "
    claim += f"{interval(humanoid[20.0])} at λ = 20, where the critic makes the robot worse than"
    harm = critics(HUMANOID)["task of the evaluation", 20.0]["high"] < 0
    yield "06", claim, humanoid[100.0].low > 0 and harm
    claim = f"The Golem's earn {interval(golem[20.0])} more at λ = 20 and {interval(golem[100.0])}"
    yield "06", f"{claim} at λ = 100", golem[20.0].low > 0 and golem[100.0].low > 0


def trust_region():
    critic = {
        (name, value): gain(name, "penalty-only", float(value))
        for name in paper.ROBOTS
        for value in paper.LAMBDAS
    }
    claim = "For the Go2 the critic adds to penalty only at every λ > 0, "
    claim += f"{interval(critic[GO2, 10])} at λ = 10 and still {interval(critic[GO2, 300])} at 300"
    yield "08", claim, all(critic[GO2, value].low > 0 for value in paper.LAMBDAS[1:])
    none = critic[GO2, 0]
    claim = f"without a trust region it adds nothing, {interval(none)}"
    yield "08", claim, none.low < 0 < none.high
    claim = "For the MIT Humanoid and the Golem it does harm up to λ = 10, "
    claim += f"{interval(critic[HUMANOID, 10])} and {interval(critic[GOLEM, 10])}, and helps from "
    claim += f"100 on, {interval(critic[HUMANOID, 100])} and {interval(critic[GOLEM, 100])}"
    others = (HUMANOID, GOLEM)
    harm = all(critic[name, value].high < 0 for name in others for value in (0, 5, 10))
    use = all(critic[name, value].low > 0 for name in others for value in (100, 150, 200, 300))
    yield "08", claim, harm and use
    claim = "the Go2's does best at λ = 10, the others' at λ = 100"
    best = [max(paper.LAMBDAS, key=lambda x: critic[name, x].mean) for name in paper.ROBOTS]  # noqa: B023
    yield "08", claim, best == [10, 100, 100]
    new = {name: gain(f"{name}_starts_from_10", "penalty-only") for name in paper.ROBOTS}
    claim = f"At λ = 100 the Go2's critic adds {interval(new[GO2])} from the other starts, the MIT "
    claim += f"Humanoid's {interval(new[HUMANOID])} and the Golem's {interval(new[GOLEM])}"
    yield "08", claim, all(abs(new[x].mean - critic[x, 100].mean) < 0.6 for x in paper.ROBOTS)
    far, start = (of(GO2, m, "distance", 0.0).mean() for m in ("vgds", "none"))
    claim = f"The Go2's ends at {far:.2f}, farther out than the {start:.2f} of a random design"
    yield "08", claim, far > start
    value, total = (
        {x: of(GO2, "vgds", q, x).mean() for x in (0.0, 10.0)}
        for q in ("predicted_value", "return")
    )
    claim = f"The critic promises {value[0.0]:.2f} there, and the body returns {total[0.0]:.1f}; "
    claim += f"at λ = 10 it promises {value[10.0]:.2f}, and the body returns {total[10.0]:.1f}"
    yield "08", claim, value[0.0] > value[10.0] and total[0.0] < total[10.0]
    worst, good = (of(HUMANOID, "vgds", "return", x).mean() for x in (0.0, 100.0))
    claim = f"The MIT Humanoid's returns {worst:.1f} instead of the {good:.1f} at λ = 100"
    yield "08", claim, worst < good
    counts = [fooled(name, 0.0) for name in paper.ROBOTS]
    claim = "{} of the Go2's ten, {} of the MIT Humanoid's and {} of the Golem's; at".format(
        *counts
    )
    yield "08", f"{claim} λ = 100 none is", all(fooled(x, 100.0) == 0 for x in paper.ROBOTS)
    r = {x: of(GO2, "vgds", "returns", x) for x in (50.0, 100.0, 150.0)}
    bend, last = paired_gain(r[100.0], (r[50.0] + r[150.0]) / 2), over_reference(GO2, 300.0)
    claim = f"our own Go2 has no bend, {interval(bend)}, and at λ = 300 it is {interval(last)}"
    yield "08", f"{claim} above", bend.low < 0 < bend.high and last.low > 0


def baselines():
    mine = {name: gain(name, "penalty-only") for name in paper.ROBOTS}
    other = [gain(name, "penalty-only", method="gc-pfo").mean for name in paper.ROBOTS]
    claim = f"VGDS gains {interval(mine[GO2])} for the Go2, {interval(mine[HUMANOID])} for the MIT "
    claim += f"Humanoid and {interval(mine[GOLEM])} for the Golem, and GC-PFO (our reading of one "
    claim += "sentence) {:+.1f}, {:+.1f} and {:+.1f}".format(*other)
    yield "09", claim, all(one.low > 0 for one in mine.values())
    method, best = max(samplers(GO2).items(), key=lambda x: x[1].mean)
    claim = f"The best of the others, CMA-ES, gains {interval(best)} for the Go2; for the other two"
    below = all(x.high < 0 for name in (HUMANOID, GOLEM) for x in samplers(name).values())
    yield "09", f"{claim} robots each of them ends below penalty only", method == "cma-es" and below
    claim = "VGDS ends above the reference for all three robots, in the paper for the Go2 alone"
    sides = [paper.SINGLE_ROBOT[x]["VGDS"] > paper.SINGLE_ROBOT[x]["f_ref"] for x in paper.ROBOTS]
    above = all(over_reference(name).low > 0 for name in paper.ROBOTS)
    yield "09", claim, above and sides == [True, False, False]
    error, steps = (
        {
            name: paired_gain(of(name, "vgds", quantity), of(name, "penalty-only", quantity))
            for name in paper.ROBOTS
        }
        for quantity in ("tracking_error", "length")
    )
    claim = f"VGDS lowers the Go2's error by {-error[GO2].mean:.3f} m/s against penalty only and "
    claim += f"the MIT Humanoid's by {-error[HUMANOID].mean:.3f}, and both last longer"
    yield "09", claim, all(error[x].high < 0 < steps[x].low for x in (GO2, HUMANOID))
    claim = "The Golem's bodies last to the end either way and track no better"
    whole = min(of(GOLEM, m, "length").min() for m in ("vgds", "penalty-only")) > 999
    yield "09", claim, whole and error[GOLEM].low < 0 < error[GOLEM].high
    heights = {m: objective(GO2, m) for m in methods(GO2)}
    pso, alone, vgds = (heights[m] for m in ("pso", "penalty-only", "vgds"))
    claim = f"PSO, comes to an objective of {pso:.1f} with the Go2, while the control comes to "
    claim += f"{alone:.1f} and VGDS to {vgds:.1f} within 50"
    yield "09", claim, pso == max(heights[m] for m in samplers(GO2))
    claim = "ρ is {:.2f}, {:.2f} and {:.2f} for the three robots".format(*map(order, paper.ROBOTS))
    yield "09", claim, all(len(samplers(name)) == 8 for name in paper.ROBOTS)
    worse = [
        paired_gain(of(name, m, "returns"), of(name, "vgds", "returns")).high < 0
        for name in paper.ROBOTS
        for m in (*samplers(name), "penalty-only")
    ]
    yield "09", "Everything but GC-PFO is worse than VGDS", all(worse)
    claim = "For all three robots the method that climbs highest, GC-PFO, also has the best bodies"
    climbers = {max(methods(x), key=functools.partial(objective, x)) for x in paper.ROBOTS}
    walkers = {max(methods(x), key=lambda m: of(x, m).mean()) for x in paper.ROBOTS}  # noqa: B023
    yield "09", claim, climbers == walkers == {"gc-pfo"}
    counts = {
        int(of(name, m, "evaluations")[0])
        for name in paper.ROBOTS
        for m in samplers(name)
        if m != "bo"
    }
    claim = f"VGDS asks 50 times, the samplers from {min(counts):,} to {max(counts):,} times"
    yield "09", claim, all(of(name, "vgds", "evaluations")[0] == 50 for name in paper.ROBOTS)


def trajectories():
    numbers = r"\s+(\S+)"
    _, common, spread, chance = map(float, output("10", rf"^VGDS, λ = 100{numbers * 4}$"))
    claim = f"the common point of VGDS lies at {common:.3f}, four times as far out as chance would "
    claim += f"give ({chance:.3f}), and the spread around it is {spread:.3f}"
    yield "10", claim, 3.5 < common / chance < 4.6
    titles = ("Unitree Go2", "MIT Humanoid", "Golem")
    rests = [output("10", rf"^{title}{numbers * 6}$")[4:] for title in titles]
    go2, humanoid, golem = (far for far, _ in rests)
    points = [int(number) for _, number in rests]
    yield "10", f"the Go2's ten starts are within {go2} of each other", points[0] == 1
    claim = f"Those of the MIT Humanoid form two groups, at most {humanoid} apart, those of the "
    yield "10", f"{claim}Golem two, at most {golem} apart", points[1:] == [2, 2]
    five, hundred = (gain(GO2, "penalty-only", value) for value in (5.0, 100.0))
    claim = f"the critic adds {interval(five)} instead of {hundred.mean:+.1f}"
    yield "10", claim, five.mean > hundred.mean
    claim = "For the MIT Humanoid the same λ costs more than all that the critic had gained"
    yield "10", claim, gain(HUMANOID, "penalty-only", 5.0).high < 0
    size, deviation = map(float, output("10", r"^Size z .* (\S+) ± (\S+) ×$"))
    mass, height = (
        float(output("10", rf"^{what}.* -(\S+) ± .* %$")[0]) for what in ("total mass", "height")
    )
    claim = f"its size along z is {size:.2f} ± {deviation:.2f} of the original, it weighs "
    yield "10", f"{claim}{mass:.1f} % less, and its trunk is {height:.0f} % lower", True
    parts = {name: size_share(name) for name in paper.ROBOTS}
    shares = [
        f"{interval(parts[name]['size only'])} of {parts[name]['all'].mean:+.1f}"
        for name in paper.ROBOTS
    ]
    claim = f"most of the gain over the reference is size**: {shares[0]} and {shares[1]}"
    most = all(parts[x]["size only"].mean > parts[x]["all"].mean / 2 for x in (GO2, HUMANOID))
    yield "10", claim, most
    alone = parts[GOLEM]["size only"]
    claim = f"The Golem's size alone is not shown to gain anything, {shares[2]}"
    yield "10", claim, alone.low < 0 < alone.high


def own_robot():
    claim = 'the answer of "Would you build it?" below is to keep the file as written'
    (verdict,) = output("16", r"^tuned: (.*)$")
    yield "16", claim, verdict == "keep the file as written."


PARTS = (
    robots_and_training,
    value_gradient_design,
    trust_region,
    baselines,
    trajectories,
    own_robot,
)


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.__name__)
def test_what_the_notebooks_state(part):
    wrong = []
    for notebook, sentence, holds in part():
        if sentence not in text(notebook):
            wrong.append(f"notebook {notebook} should say: {sentence}")
        elif not holds:
            wrong.append(f"not true any more, in notebook {notebook}: {sentence}")
    assert not wrong, "\n".join(wrong)


def test_results_of_the_critics_belong_to_the_shipped_agents():
    for name in paper.ROBOTS:
        file = data_dir() / "results" / f"critic_tasks_{name}.json"
        source = results.stored_result(file)["provenance"]["agent"]
        assert source["hash"] == load_agent(name).hash
