"""Design studies: searches from the paper's start designs, and what the designs are worth.

Section 4.1 (methods), Appendix D (trust region).
"""

from dataclasses import asdict, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from shapebody import paper
from shapebody.checkpoints import require_agent
from shapebody.checks import (
    refuse,
    require_choice,
    require_flag,
    require_integer,
    require_kind,
    require_list,
    require_number,
    require_records,
    require_seed,
    require_text,
    shown,
)
from shapebody.design import DesignSpace
from shapebody.evaluation import EvaluationConfig, evaluate, paired_gain
from shapebody.experiments import (
    result,
    result_in_parts,
    result_path,
    stored_config,
    stored_parts,
    stored_result,
)
from shapebody.locomotion import TaskConfig
from shapebody.paths import data_dir
from shapebody.published import load_published_policy
from shapebody.robots import require_robot
from shapebody.search import METHODS, Objective, search


class Run(NamedTuple):
    """One search of a design study."""

    method: str
    """A name in `search.METHODS`."""
    trust_region: float | None = 100.0
    """λ. None for the penalty alone: Adam removes the scale of its gradient, so it has none."""
    origin: str = "start"
    """"start": from the paper's start designs, all in one batch; "reference": from f = 0."""


CONTROL = Run("penalty-only", None)
TRUST_REGION_RUNS = (CONTROL, *(Run("vgds", float(value)) for value in paper.LAMBDAS))
"""VGDS at all λ of Appendix D, and its control."""
SINGLE_ROBOT_RUNS = (
    CONTROL,
    Run("vgds", 20.0),
    Run("vgds", 100.0),
    Run("vgds", 20.0, "reference"),
    Run("vgds", 100.0, "reference"),
)
"""What the critic adds to the pull of the trust region, from afar and from the reference."""
FRESH_RUNS = (CONTROL, *(Run("vgds", value) for value in (20.0, 50.0, 100.0, 200.0)))
"""To be repeated from other start designs than the paper's, which have decided nothing."""
METHOD_RUNS = (CONTROL, *(Run(name) for name in METHODS if name != "penalty-only"))
"""All methods at the paper's λ (Section 4.1, Appendix C)."""


def design_study(
    agent,
    robot,
    runs=SINGLE_ROBOT_RUNS,
    starts: int = 10,
    episodes: int = 200,
    horizon: int = 1000,
    seed: int = 0,
    iterations: int | None = None,
    first_start: int = 0,
    recompute: bool = False,
    progress: bool = False,
) -> dict:
    """Search for designs in several ways and let the frozen policy walk with all of them.

    Every found design, every start and the reference are evaluated on the same episodes of
    `horizon` control steps. The result is kept in data/results, run by run (`result_in_parts`), in
    a file of its own for every robot file.

    Args:
        agent, robot: who is asked, and about which robot.
        runs: the searches.
        starts: number of start designs.
        episodes: least number of evaluation episodes per design. A stored study of more is used
            as it is, and what it lacks is computed with as many; to have fewer, delete its file.
        seed: of the searches and of the evaluation.
        iterations: of every search; the paper's number for each method if not given.
        first_start: number of the first start design. The paper's are 0 to 9; others have a file
            of their own.
        recompute: search and evaluate anew.
        progress: print a line per run.

    Returns:
        {"records": ..., "provenance": ...} with one record per design: origin, start number,
        method ("none" for the designs where searches begin), trust_region, the search's seconds
        per design (without compilation), critic evaluations per design, mean return, the returns
        of all episodes, tracking error (m/s), length (control steps), number of episodes that
        became non-finite, predicted value (mean critic value over the state bank, without
        penalty), distance |f - f_ref| / sqrt(d), and the curve of the search: evaluations and
        objective (on the whole state bank) at some of its iterations.

    Raises:
        ValueError: for a run or a setting that cannot be, before anything is computed.
    """
    require_agent(agent)
    require_robot(robot)
    runs, setting, short = _settings(
        runs, starts, episodes, horizon, seed, first_start, iterations, recompute
    )
    require_flag("progress", progress)
    name = _file(robot, first_start)
    setting = _as_stored(name, agent, setting, short)
    parts = {"starts and reference": partial(_initial_records, agent, robot, **setting)}
    for run in runs:
        parts[_part(run)] = partial(_run_records, agent, robot, run, short, **setting)
    return result_in_parts(
        name, parts, agent, recompute, progress, _searches(runs, short), **setting, **short
    )


def _settings(runs, starts, episodes, horizon, seed, first_start, iterations, recompute):
    """(runs, setting, settings of every search) of a study; ValueError for what cannot be."""
    _require_counts(starts=starts, episodes=episodes, horizon=horizon)
    for name, value in (("seed", seed), ("first_start", first_start)):
        require_integer(name, value, 0, 1_000_000)
    setting = _setting(starts, episodes, horizon, seed, first_start)
    short = {} if iterations is None else {"iterations": iterations}
    runs = require_list("runs", runs)
    for run in runs:
        require_kind("a run", run, Run, 'for example studies.Run("vgds", 100.0)')
        _validate(run, short)
    require_flag("recompute", recompute)
    return runs, setting, short


def _searches(runs, short: dict) -> dict[str, dict]:
    """By name of the part, the settings of its search."""
    return {_part(run): asdict(METHODS[run.method].config(**short)) for run in runs}


def _setting(starts, episodes, horizon, seed, first_start) -> dict:
    """What a stored study depends on; `first_start` is named only where it is not 0."""
    setting = dict(starts=starts, episodes=episodes, horizon=horizon, seed=seed)
    return setting if first_start == 0 else setting | {"first_start": first_start}


def _as_stored(name, agent, setting: dict, short: dict) -> dict:
    """The setting with the number of episodes of the stored study, if that is larger."""
    stored = stored_config(name, agent) or {}
    episodes = stored.get("episodes", 0)
    same = stored == setting | short | {"episodes": episodes}
    return setting | {"episodes": episodes} if same and episodes > setting["episodes"] else setting


def _validate(run: Run, settings: dict) -> None:
    if not isinstance(run.method, str) or run.method not in METHODS:
        raise ValueError(f"unknown method in {shown(run)}; known: {', '.join(METHODS)}")
    require_choice("origin of a run", run.origin, ("start", "reference"))
    value, alone = run.trust_region, run.method == CONTROL.method
    if alone and value is not None:
        raise refuse(f"trust_region of {run.method}", value, "None, it has no λ")
    if not alone:
        require_number(f"trust_region of {run.method}", value, 0)
    METHODS[run.method].config(**settings)  # refuses what the method cannot use


def _file(robot, first_start: int) -> str:
    """Name of a study's file. A robot that is not the shipped one of its name has its own."""
    shipped = data_dir() / "robots" / f"{robot.name}.xml"
    known = shipped.is_file() and shipped.read_text(encoding="utf-8") == robot.xml
    suffix = "" if known else f"_{robot.hash}"
    suffix += f"_starts_from_{first_start}" if first_start else ""
    return f"design_study_{robot.name}{suffix}"


def _part(run: Run) -> str:
    text = "" if run.trust_region is None else f", lambda {run.trust_region:g}"
    where = "starts" if run.origin == "start" else run.origin
    return f"{run.method}{text}, from the {where}"


def installed(runs) -> tuple[Run, ...]:
    """Those of `runs` whose libraries are there: "bo" needs the extra `bo`."""
    from importlib.util import find_spec

    runs = require_list("runs", runs)
    for run in runs:
        require_kind("a run", run, Run, 'for example studies.Run("vgds", 100.0)')
    return tuple(run for run in runs if run.method != "bo" or find_spec("botorch"))


def available(
    agent,
    robot,
    runs,
    starts: int = 10,
    episodes: int = 200,
    horizon: int = 1000,
    seed: int = 0,
    iterations: int | None = None,
    first_start: int = 0,
    recompute: bool = False,
) -> tuple[Run, ...]:
    """Those of `runs` that `design_study` can return here for the same arguments.

    All but "bo" always; "bo" where its libraries are `installed`, or where its part is stored.
    """
    require_agent(agent)
    require_robot(robot)
    runs, setting, short = _settings(
        runs, starts, episodes, horizon, seed, first_start, iterations, recompute
    )
    name = _file(robot, first_start)
    setting = _as_stored(name, agent, setting, short)
    searches = _searches(runs, short)
    stored = [] if recompute else stored_parts(name, agent, searches, **setting, **short)
    here = installed(runs)
    return tuple(run for run in runs if run in here or _part(run) in stored)


CURVE_POINTS = 21
"""Iterations of a search at which its record holds the objective."""


def _origins(robot, run: Run, starts: int, first_start: int):
    """Numbers of the start designs (None for the reference), and the designs [n, d]."""
    space = DesignSpace(robot)
    if run.origin == "reference":
        return [None], space.reference[None]
    numbers = list(range(first_start, first_start + starts))
    return numbers, np.stack([space.start(i) for i in numbers])


def _initial_records(agent, robot, starts, first_start=0, **setting):
    records = []
    for run in (Run("none", None), Run("none", None, "reference")):
        numbers, designs = _origins(robot, run, starts, first_start)
        records += _evaluated(agent, robot, run, numbers, designs, **setting)
    return records


def _run_records(agent, robot, run: Run, short, starts, seed, first_start=0, **setting):
    numbers, initial = _origins(robot, run, starts, first_start)
    given = 100.0 if run.trust_region is None else run.trust_region
    found = search(run.method, agent, robot, initial, trust_region=given, seed=seed, **short)
    records = _evaluated(agent, robot, run, numbers, found.design, seed=seed, **setting)
    last = len(found.trajectory) - 1
    rows = np.unique(np.linspace(0, last, CURVE_POINTS).round().astype(int))
    # BO scores some designs before its first iteration.
    before = found.settings.get("initial_points", 0)

    def evaluations_until(row):
        return 0 if row == 0 else before + round((found.evaluations - before) * row / last)

    objective = Objective.of(agent, robot, given)
    curves = np.stack([np.asarray(objective(found.trajectory[row])) for row in rows], 1)
    for record, curve in zip(records, curves, strict=True):
        record |= {
            "search_seconds": (found.seconds - found.compile_seconds) / len(initial),
            "evaluations": found.evaluations,
            "curve_evaluations": [evaluations_until(row) for row in rows.tolist()],
            "curve_objective": [round(float(value), 4) for value in curve],
        }
    return records


def _evaluated(agent, robot, run: Run, numbers, designs, seed, episodes, horizon):
    """A record per design; `numbers` are those of the start designs they came from."""
    predicted = Objective.of(agent, robot, 0.0).value(designs)
    score = evaluate(agent, robot, designs, seed=seed, config=_evaluation(episodes, horizon))
    return [
        {
            "origin": run.origin,
            "start": numbers[i],
            "method": run.method,
            "trust_region": run.trust_region,
            "return": float(score.returns[i].mean()),
            "tracking_error": float(score.tracking_error[i].mean()),
            "length": float(score.lengths[i].mean()),
            "non_finite": int(score.non_finite[i]),
            "predicted_value": float(predicted[i]),
            "distance": float(np.sqrt(np.mean(designs[i] ** 2))),
            "engine": score.settings["engine"],
            "returns": [round(value, 3) for value in score.returns[i].tolist()],
        }
        for i in range(len(designs))
    ]


def _evaluation(episodes: int, horizon: int):
    return EvaluationConfig(episodes=episodes, task=TaskConfig.evaluation(horizon=horizon))


def gains(records: list[dict], quantity: str = "return") -> list[dict]:
    """Gains in return ΔR with 95 % intervals, from the records of `design_study`.

    Args:
        records: of one robot.
        quantity: "return"; or another number of a record, such as "tracking_error", for
            comparisons between starts (those from the reference are left out).

    Returns:
        One record per comparison: method, over ("start", "penalty-only" or "reference"),
        trust_region (None where none was used), mean, low and high of the paired difference,
        the number of pairs, and how many of them are positive. The pairs are the starts; for the
        search from the reference they are the episodes of one pair of designs. Intervals of
        returns are over starts and episodes (`paired_gain`), those of other quantities over starts
        alone, which leaves out the luck with the episodes that all starts share.

    Raises:
        ValueError: if a design has no counterpart to be compared with, or the records come from
            two engines.
    """
    records = require_records("records", records, ("origin", "method", "trust_region", "start"))
    require_text("quantity", quantity)
    # Returns are stored by episode, other quantities as means.
    detail = "returns" if quantity == "return" else quantity
    for record in records:
        if detail not in record:
            raise ValueError(f"quantity is {shown(quantity)}; expected one of {', '.join(record)}")
    found: dict = {}
    for record in records:
        if record["origin"] == "start":
            key = record["method"], record["trust_region"]
            found.setdefault(key, {})[record["start"]] = record[detail]
    reference = [r for r in records if r["origin"] == "reference"]
    base = [r for r in reference if r["method"] == "none"]
    initial = found.get(("none", None), {})
    engines = sorted({r["engine"] for r in records if "engine" in r})
    if len(engines) > 1:
        raise ValueError(
            f"the records come from the engines {', '.join(engines)}, whose episodes are not the "
            "same; compute all of them with one (recompute=True)"
        )
    if len(base) != 1 or not initial:
        raise ValueError(
            f"the records hold {len(base)} evaluations of the reference and {len(initial)} of "
            "starts; expected one and at least one, as design_study returns them"
        )
    rows = []

    def compare(method, over, trust_region, after, before):
        if after.keys() != before.keys():
            raise ValueError(
                f"{method} at lambda {trust_region} has starts {sorted(after)}, {over} has "
                f"{sorted(before)}; both need the same, compute the records anew"
            )
        order = sorted(after)
        gain = paired_gain([after[i] for i in order], [before[i] for i in order])
        row(method, over, trust_region, *gain[:3], len(order), int(np.sum(gain.differences > 0)))

    def row(method, over, trust_region, mean, low, high, pairs, positive):
        values = dict(mean=mean, low=low, high=high, pairs=pairs, positive=positive)
        rows.append({"method": method, "over": over, "trust_region": trust_region, **values})

    compare("reference", "start", None, dict.fromkeys(initial, base[0][detail]), initial)
    for (method, trust_region), after in found.items():
        if method == "none":
            continue
        compare(method, "start", trust_region, after, initial)
        if method != "penalty-only":
            control = found.get(("penalty-only", None))
            if control is not None:
                compare(method, "penalty-only", trust_region, after, control)
    for r in reference:
        if r["method"] != "none" and quantity == "return":
            own = paired_gain(r["returns"], base[0]["returns"])
            positive = int(np.sum(own.differences > 0))
            row(r["method"], "reference", r["trust_region"], *own[:3], len(r["returns"]), positive)
    return rows


def gain(rows: list[dict], method: str, over: str, trust_region: float | None = None) -> dict:
    """The one row of `gains` with that method, comparison and λ; ValueError if there is none."""
    require_text("method", method)
    require_text("over", over)
    if trust_region is not None:
        require_number("trust_region", trust_region, 0)
    wanted = {"method": method, "over": over, "trust_region": trust_region}
    rows = require_records("rows", rows, wanted)
    for row in rows:
        if all(row[name] == value for name, value in wanted.items()):
            return row
    known = ", ".join(f"{r['method']} over {r['over']} at {r['trust_region']}" for r in rows)
    raise ValueError(
        f"there is no gain of {shown(method)[1:-1]} over {shown(over)[1:-1]} at {trust_region}; "
        f"known: {known or 'none'}"
    )


def value_against_return(
    agent,
    robot,
    designs: int = 256,
    episodes: int = 8,
    horizon: int = 1000,
    seed: int = 1000,
    progress: bool = False,
) -> list[dict]:
    """Predicted value and true return of random designs of the full design space.

    Returns:
        One record per design: its number, predicted value and mean return.
    """
    require_agent(agent)
    _require_counts(designs=designs, episodes=episodes, horizon=horizon)
    require_seed("seed", seed)
    require_flag("progress", progress)
    space = DesignSpace(robot)
    f = np.stack([space.start(seed + i) for i in range(designs)])
    predicted = np.asarray(Objective.of(agent, robot, 0.0).value(f))
    config = _evaluation(episodes, horizon)
    score = evaluate(agent, robot, f, seed=seed, config=config, progress=progress)
    return [
        {
            "design": seed + i,
            "predicted_value": float(predicted[i]),
            "return": float(score.returns[i].mean()),
        }
        for i in range(designs)
    ]


def size_share(
    agent,
    robot,
    starts: int = 10,
    episodes: int = 50,
    horizon: int = 1000,
    seed: int = 0,
    iterations: int | None = None,
) -> list[dict]:
    """How much of what VGDS (λ = 100) finds is the size of the body, and how much all the rest.

    Three entries of f scale the whole body along its axes. Every found design is taken apart into
    these (all other entries at the reference) and the rest (these at the reference), like the
    paper's counterfactuals (Section 4.3), which put groups into the start design instead.

    Returns:
        One record per body: kept ("reference", "all", "size only", "all but size"), start number
        (None for the reference), predicted value, and the returns of all episodes.
    """
    require_agent(agent)
    _require_counts(starts=starts, episodes=episodes, horizon=horizon)
    require_seed("seed", seed)
    space = DesignSpace(robot)
    short = {} if iterations is None else {"iterations": iterations}
    METHODS["vgds"].config(**short)  # refuses wrong iterations
    initial = np.stack([space.start(i) for i in range(starts)])
    found = search("vgds", agent, robot, initial, trust_region=100.0, seed=seed, **short).design
    size = np.zeros(space.dim, bool)
    size[space.slices["size"]] = True
    bodies = {
        "reference": space.reference[None],
        "all": found,
        "size only": np.where(size, found, 0.0),
        "all but size": np.where(size, 0.0, found),
    }
    designs = np.concatenate(list(bodies.values())).astype(np.float32)
    predicted = Objective.of(agent, robot, 0.0).value(designs)
    score = evaluate(agent, robot, designs, seed=seed, config=_evaluation(episodes, horizon))
    names = [(kept, i) for kept, rows in bodies.items() for i in range(len(rows))]
    return [
        {
            "kept": kept,
            "start": None if kept == "reference" else number,
            "predicted_value": float(value),
            "returns": [round(x, 3) for x in returns.tolist()],
        }
        for (kept, number), value, returns in zip(names, predicted, score.returns, strict=True)
    ]


def _require_counts(**counts) -> None:
    for name, value in counts.items():
        require_integer(name, value, 1, 1_000_000)


def published_policy(robot, agent, folder=None, starts: int = 10, episodes: int = 16) -> dict:
    """Returns that the authors' published policy earns in our environment.

    The start designs turn frames and joint axes about our own axes, not about those of the
    authors' (`DesignSpace(published_axes_of=...)`), so the bodies differ a little from theirs.

    Args:
        robot: the robot of that policy.
        agent: any agent for it; only its policy is replaced.
        folder: with the authors' files (`load_published_policy`). Without it the stored result
            is returned.
        starts, episodes: start designs, and evaluation episodes per design.

    Returns:
        {"records": ..., "provenance": ...} with records of the reference and of the starts as in
        `design_study`, without what a critic has to say.

    Raises:
        FileNotFoundError: if nothing is stored and no folder is given.
    """
    require_robot(robot)
    require_agent(agent)
    _require_counts(starts=starts, episodes=episodes)
    name = f"published_policy_{robot.name}"
    if folder is None:
        # Theirs is the same policy at all scales.
        for path in (result_path(name), data_dir() / "results" / f"{name}.json"):
            if path.exists():
                return stored_result(path)
        raise FileNotFoundError(
            f"{path.name} is not in data/results; give the folder of the authors' weights"
        )

    def compute():
        module, variables = load_published_policy(folder, robot.name)
        theirs = replace(agent, name="published", policy_config=module.config, policy=variables)
        space = DesignSpace(robot)
        rows = [("reference", None, space.reference)]
        rows += [("start", i, space.start(i)) for i in range(starts)]
        score = evaluate(theirs, robot, np.stack([f for *_, f in rows]), episodes)
        return [
            {
                "origin": origin,
                "start": number,
                "return": float(score.returns[i].mean()),
                "tracking_error": float(score.tracking_error[i].mean()),
                "length": float(score.lengths[i].mean()),
                "engine": score.settings["engine"],
                "returns": [round(value, 3) for value in score.returns[i].tolist()],
            }
            for i, (origin, number, _) in enumerate(rows)
        ]

    return result(name, compute, recompute=True, starts=starts, episodes=episodes)
