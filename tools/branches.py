"""Two branches of one training run, with equal time: does a change of settings pay?

    python -m tools.branches NAME --run unitree_go2 --minutes 30 --change '{"epochs": 1}'

Both branches begin with copies of the run's state and take turns of a few minutes, so that other
work on the machine slows both alike. Then the yardstick measures the run's policy and both
branches', on the same bodies, and the comparison is added to data/results/training_branches.json.
Stopped, it goes on when it is called again. Beside other settings, a branch may differ in fields of
the task: --change '{"task": {"delay_probability": 0.0}}'.
"""

import json
import shutil
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from shapebody.evaluation.statistics import bootstrap_interval
from shapebody.reproduction.results import result_in_parts
from shapebody.robot.robot import load_robot
from shapebody.runtime import enable_compilation_cache
from shapebody.training.run_state import (
    CURVE,
    PHASES,
    STATE,
    finished_iterations,
    read_config,
    run_folder,
    saved_state,
)
from shapebody.training.trainer import Trainer
from shapebody.training.update import learned_policy
from shapebody.training.yardstick import yardstick

COEFFICIENTS = (1.0, 0.5)


def changed(config, changes: dict):
    """The configuration with changes by name, nested ones as dictionaries."""
    new = {}
    for name, value in changes.items():
        old = getattr(config, name)
        new[name] = changed(old, value) if is_dataclass(old) else value
    return replace(config, **new)


def copied(run: Path, folder: Path) -> Path:
    """A copy of the run's files, unless there is one."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in (PHASES, CURVE, (saved_state(run) or run / STATE).name):  # the state comes last
        if not (folder / name).exists():
            shutil.copyfile(run / name, folder / name)
    return folder


def branch(run: Path, folder: Path, config) -> Trainer:
    """A trainer of a copy of the run, with `config` from here on."""
    trainer = Trainer(config, copied(run, folder))
    trainer.start(changeable=[field.name for field in fields(config)])
    return trainer


def measured(trainer: Trainer, robots) -> dict:
    """{c: Measured} of the policy of a trainer."""
    policy = trainer.config.policy, learned_policy(trainer.learner)
    return {c: yardstick(*policy, robots, c) for c in COEFFICIENTS}


def summary(of: dict) -> dict:
    """Success and return by c, as they are stored."""
    return {
        f"{what}_c{c:g}": round(float(np.mean(getattr(of[c], field))), 4)
        for c in COEFFICIENTS
        for what, field in (("success", "success"), ("return", "returns"))
    }


def gains(old: dict, new: dict) -> dict:
    """[mean, low, high] of the paired differences over the bodies."""
    found = {}
    for c in COEFFICIENTS:
        for what, field in (("success", "success"), ("return", "returns")):
            a, b = (np.asarray(getattr(x[c], field), float) for x in (new, old))
            bounds = bootstrap_interval(a, b)
            found[f"{what}_c{c:g}"] = [round(float(x), 4) for x in (np.mean(a - b), *bounds)]
    return found


def compare(name: str, run: Path, folder: Path, changes: dict, minutes: float, turn: float):
    """The records of an experiment; see the module."""
    begun = copied(run, folder / name / "begun")  # the run itself may go on
    config = read_config(begun)
    rate = rate_now(begun, config)
    base = replace(config, yardstick_interval=None, total_steps=10**12, learning_rate=(rate, rate))
    trainers = {
        "as before": branch(begun, folder / name / "old", base),
        "changed": branch(begun, folder / name / "new", changed(base, changes)),
    }
    before = Trainer(base, begun)
    before.start(changeable=[field.name for field in fields(base)])
    steps, seconds = before.steps, before.seconds

    # Turns, the branch that has had less time first.
    budget = 60 * minutes
    used = {key: x.seconds - seconds for key, x in trainers.items()}
    while min(used.values()) < budget:
        key = min(used, key=used.get)
        trainer = trainers[key]
        trainer.run(max_seconds=min(60 * turn, budget - used[key]), progress=False)
        used = {key: x.seconds - seconds for key, x in trainers.items()}
        print(
            "; ".join(
                f"{key}: {used[key] / 60:.1f} min, {x.steps - steps:,} steps"
                for key, x in trainers.items()
            ),
            flush=True,
        )

    # The yardstick, of the state at which both began as well.
    robots = [load_robot(robot) for robot in base.robots]
    found = {"begun": measured(before, robots)}
    found |= {key: measured(trainer, robots) for key, trainer in trainers.items()}
    records = [
        {
            "branch": key,
            "steps": 0 if key == "begun" else trainers[key].steps - steps,
            "minutes": 0.0 if key == "begun" else round(used[key] / 60, 2),
            **summary(of),
            "over_begun": gains(found["begun"], of),
            "over_as_before": gains(found["as before"], of),
        }
        for key, of in found.items()
    ]
    return [record | {"run": run.name, "from_step": steps} for record in records]


def rate_now(run: Path, config) -> float:
    """The learning rate that a run has reached."""
    first, last = config.learning_rate
    return first + (last - first) * min(finished_iterations(run) / config.iterations, 1.0)


def main(
    name: Annotated[str, tyro.conf.Positional],
    run: str,
    change: str,
    minutes: float = 30.0,
    turn: float = 5.0,
    folder: Path = Path("branches"),
) -> None:
    """Compare two branches of a run.

    Args:
        name: of the experiment.
        run: name of the agent whose run it is, or its folder.
        change: JSON of the settings that the second branch has.
        minutes: training time of each branch.
        turn: minutes of a turn.
        folder: where the branches are kept.
    """
    enable_compilation_cache()
    path, changes = run_folder(run), json.loads(change)
    compute = {name: lambda: compare(name, path, folder, changes, minutes, turn)}
    settings = {name: {"change": changes, "minutes": minutes}}
    found = result_in_parts("training_branches", compute, settings=settings)
    print(json.dumps(found["records"], indent=1))


if __name__ == "__main__":
    tyro.cli(main)
