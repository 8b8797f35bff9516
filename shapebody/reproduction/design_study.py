"""Design studies: searches from the paper's start designs, and what the designs are worth.

Section 4.1 (methods), Appendix D (trust region).
"""

from dataclasses import asdict
from functools import partial
from typing import NamedTuple

import numpy as np

from shapebody.agent.agent import require_agent
from shapebody.arguments import (
    refuse,
    require_choice,
    require_flag,
    require_integer,
    require_kind,
    require_list,
    require_number,
    shown,
)
from shapebody.design.space import DesignSpace
from shapebody.evaluation.evaluate import EvaluationConfig, evaluate
from shapebody.files import data_dir
from shapebody.optimizers.objective import Objective
from shapebody.optimizers.search import METHODS, search
from shapebody.reproduction import paper
from shapebody.reproduction.results import result_in_parts, stored_config, stored_parts
from shapebody.robot.robot import require_robot
from shapebody.task.config import TaskConfig


class Run(NamedTuple):
    """One search of a design study."""

    method: str
    """A name in `search.METHODS`."""
    trust_region: float | None = 100.0
    """λ; None for penalty only, where it has no influence: Adam removes the scale of a gradient."""
    origin: str = "start"
    """"start": from the paper's start designs, all in one batch; "reference": from f = 0."""


PENALTY_ONLY = Run("penalty-only", None)
"""What is gained without the critic, with which the gains of all other runs are compared."""

TRUST_REGION_RUNS = (PENALTY_ONLY, *(Run("vgds", float(value)) for value in paper.LAMBDAS))
"""VGDS at all λ of Appendix D, and penalty only."""

SINGLE_ROBOT_RUNS = (
    PENALTY_ONLY,
    Run("vgds", 20.0),
    Run("vgds", 100.0),
    Run("vgds", 20.0, "reference"),
    Run("vgds", 100.0, "reference"),
)
"""What the critic adds to penalty only, from the starts; and VGDS from the reference."""

FRESH_RUNS = (PENALTY_ONLY, *(Run("vgds", value) for value in (20.0, 50.0, 100.0, 200.0)))
"""For other start designs than the paper's, on which no setting has been chosen."""

METHOD_RUNS = (PENALTY_ONLY, *(Run(name) for name in METHODS if name != "penalty-only"))
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
        agent, robot: the frozen agent, and the robot to be designed.
        runs: the searches.
        starts: number of start designs.
        episodes: least number of evaluation episodes per design. A stored study of more is used
            as it is, and its missing runs are computed with as many.
        seed: of the searches and of the evaluation.
        iterations: of every search; the paper's number for each method if not given.
        first_start: number of the first start design. The paper's are 0 to 9; others have a file
            of their own.
        recompute: search and evaluate again, and overwrite what is stored.
        progress: print a line per run that is computed.

    Returns:
        {"records": ..., "provenance": ...} with one record per design: origin, start number,
        method ("none" for the designs where searches begin), trust_region, the search's seconds
        per design (without compilation), critic evaluations per design, mean return, the returns
        of all episodes, tracking error (m/s), length (control steps), number of episodes that
        became non-finite, predicted value (mean critic value over the state bank, without
        penalty), distance |f - f_ref| / sqrt(d), and the curve of the search: evaluations and
        objective (on the whole state bank) at some of its iterations.

    Raises:
        ValueError: for a run or a setting that is not possible, before anything is computed; if
            the stored study is another agent's or has other settings, unless `recompute`.
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
        parts[part_name(run)] = partial(_run_records, agent, robot, run, short, **setting)
    return result_in_parts(
        name, parts, agent, recompute, progress, search_settings(runs, **short), **setting, **short
    )


def _settings(runs, starts, episodes, horizon, seed, first_start, iterations, recompute):
    """(runs, setting, settings of every search) of a study; ValueError for what is not possible."""
    require_counts(starts=starts, episodes=episodes, horizon=horizon)
    for name, value in (("seed", seed), ("first_start", first_start)):
        require_integer(name, value, 0, 1_000_000)
    setting = _setting(starts, episodes, horizon, seed, first_start)
    short = {} if iterations is None else {"iterations": iterations}
    runs = require_list("runs", runs)
    for run in runs:
        require_kind("a run", run, Run, 'for example design_study.Run("vgds", 100.0)')
        _validate(run, short)
    require_flag("recompute", recompute)
    return runs, setting, short


def search_settings(runs, **settings) -> dict[str, dict]:
    """The settings of the runs' searches by `part_name`; those not given are the methods'."""
    return {part_name(run): asdict(METHODS[run.method].config(**settings)) for run in runs}


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
    value = run.trust_region
    if run.method == PENALTY_ONLY.method:
        if value is not None:
            raise refuse(f"trust_region of {run.method}", value, "None, since λ has no influence")
    else:
        require_number(f"trust_region of {run.method}", value, 0)
    METHODS[run.method].config(**settings)  # refuses what the method cannot use


def _file(robot, first_start: int) -> str:
    """Name of a study's file. A robot that differs from the shipped one of its name has its own."""
    shipped = data_dir() / "robots" / f"{robot.name}.xml"
    known = shipped.is_file() and shipped.read_text(encoding="utf-8") == robot.xml
    suffix = "" if known else f"_{robot.hash}"
    suffix += f"_starts_from_{first_start}" if first_start else ""
    return f"design_study_{robot.name}{suffix}"


def part_name(run: Run) -> str:
    """Name of a run's part in the file of a study, such as "vgds, lambda 20, from the starts"."""
    text = "" if run.trust_region is None else f", lambda {run.trust_region:g}"
    where = "starts" if run.origin == "start" else run.origin
    return f"{run.method}{text}, from the {where}"


def installed(runs) -> tuple[Run, ...]:
    """Those of `runs` whose libraries are installed: "bo" needs the extra `bo`."""
    from importlib.util import find_spec

    runs = require_list("runs", runs)
    for run in runs:
        require_kind("a run", run, Run, 'for example design_study.Run("vgds", 100.0)')
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

    That is all of them, but "bo" only if its libraries are `installed` or its part is stored.
    """
    require_agent(agent)
    require_robot(robot)
    runs, setting, short = _settings(
        runs, starts, episodes, horizon, seed, first_start, iterations, recompute
    )
    name = _file(robot, first_start)
    setting = _as_stored(name, agent, setting, short)
    searches = search_settings(runs, **short)
    stored = [] if recompute else stored_parts(name, agent, searches, **setting, **short)
    here = installed(runs)
    return tuple(run for run in runs if run in here or part_name(run) in stored)


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
    score = evaluate(agent, robot, designs, seed=seed, config=evaluation_config(episodes, horizon))
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


def evaluation_config(episodes: int, horizon: int) -> EvaluationConfig:
    """How the studies evaluate designs: episodes of `horizon` control steps."""
    return EvaluationConfig(episodes=episodes, task=TaskConfig.evaluation(horizon=horizon))


def require_counts(**counts) -> None:
    """ValueError if one of the named numbers is not an integer from 1 to 1,000,000."""
    for name, value in counts.items():
        require_integer(name, value, 1, 1_000_000)
