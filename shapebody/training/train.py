"""Training runs from beginning to end: train, continue, anneal."""

import dataclasses
import json
import os
import secrets
import shutil
from collections.abc import Mapping
from pathlib import Path

from shapebody.agent.agent import Agent
from shapebody.agent.store import chosen_folder, load_agent
from shapebody.arguments import (
    require_engine,
    require_flag,
    require_integer,
    require_kind,
    require_number,
)
from shapebody.configuration import from_json
from shapebody.files import atomic_write
from shapebody.robot.robot import find
from shapebody.stored import read_json
from shapebody.training.config import MOST_STEPS, TrainConfig, located
from shapebody.training.progress import announce
from shapebody.training.replacing import require_replaceable, steps_in
from shapebody.training.run_state import (
    CURVE,
    PHASES,
    STATE,
    finished_iterations,
    has_run,
    read_config,
    read_phases,
    require_budget,
    require_own_config,
    require_run,
    run_engine,
    run_folder,
    saved_state,
)
from shapebody.training.trainer import Trainer

FIXED = ("name", "scale", "seed", "num_envs", "rollout_length")
"""Settings of a run that cannot be overridden. Its numbers of steps and random numbers depend on
them; sizes of networks cannot be either, since the arrays of the run have them."""


def train(
    config: TrainConfig,
    folder=None,
    progress: bool = True,
    max_steps: int | None = None,
    max_seconds: float | None = None,
    engine: str = "auto",
    state_only: bool = False,
    replace: bool = False,
) -> Agent | None:
    """Train an agent, or continue its training, and save it.

    A run that was stopped is continued exactly where it was by the same configuration. Any other
    configuration is another run, with another name or folder: `continue_run` continues a run whose
    configuration is not at hand, and can override settings.

    An interrupt (Ctrl-C) ends the call early, with the agent of the last iteration; before the
    first one there is nothing to save, and KeyboardInterrupt is raised. A call that trains nothing,
    because the run is at its end or at `max_steps`, leaves an agent of at least as many steps in
    the folder as it is, with the critic that `train_critic` may have given it.

    Args:
        config: the run, for example `TrainConfig.reduced("unitree_go2")`.
        folder: where run and agent are kept; data/checkpoints/<name> by default.
        progress: show return, tracking error, curriculum coefficient, speed and time left.
        max_steps: stop once this many steps in all have been consumed.
        max_seconds: stop after this many seconds. After either, the run can be continued.
        engine: "native", "mjx" or "auto", see `Trainer`.
        state_only: leave the agent in the folder as it is; the run can be annealed later.
        replace: replace the agent in the folder even if it has more steps than the run, or if
            nothing was trained.

    Returns:
        The agent in the folder, with its state bank; None with `state_only`.

    Raises:
        ValueError: if `max_steps` is less than one iteration, if the agent in the folder has more
            steps than the run that is to go on, or if the run there has another configuration (the
            error lists the settings that differ).
    """
    require_run(config, engine)
    _require_call(engine, progress, max_steps, max_seconds, state_only, replace)
    return _train(config, folder, progress, (max_steps, max_seconds), engine, state_only, replace)


def continue_run(
    name_or_folder: str | Path,
    overrides: Mapping | None = None,
    progress: bool = True,
    max_steps: int | None = None,
    max_seconds: float | None = None,
    engine: str = "auto",
    state_only: bool = False,
    replace: bool = False,
) -> Agent | None:
    """Continue a run with the configuration that it has, whatever the defaults are now.

    Args:
        name_or_folder: of the run. A Path, or a string with a path separator in it, is a folder;
            any other string is a name in data/checkpoints.
        overrides: settings by name that the run has from here on, such as
            `{"learning_rate": (3e-5, 3e-5)}`; training.json records them as a new phase. A robot
            whose file has moved is given as "robots".
        progress, max_steps, max_seconds, engine, state_only, replace: see `train`.

    Returns:
        As `train`.

    Raises:
        FileNotFoundError: if there is no such run.
        ValueError: as `train`, and if a setting cannot be overridden.
    """
    folder = run_folder(name_or_folder)
    overrides = {} if overrides is None else overrides
    _require_overrides(overrides)
    _require_call(engine, progress, max_steps, max_seconds, state_only, replace)
    config = dataclasses.replace(read_config(folder), **overrides)
    budget = max_steps, max_seconds
    return _train(config, folder, progress, budget, engine, state_only, replace, overrides)


def _require_overrides(overrides) -> None:
    """TypeError or ValueError if these are not settings that a run can change."""
    require_kind("overrides", overrides, Mapping, "of settings by name")
    free = [field.name for field in dataclasses.fields(TrainConfig) if field.name not in FIXED]
    for name in overrides:
        if name not in free:
            raise ValueError(
                f"overrides has {name!r}; expected settings of a run that can change "
                f"({', '.join(free)}): begin a run under another name for others"
            )


def _require_call(engine, progress, max_steps, max_seconds, state_only, replace) -> None:
    """ValueError if an argument of `train` or `continue_run` is not what it should be."""
    require_engine("engine", engine)
    require_budget(max_steps, max_seconds, progress)
    require_flag("state_only", state_only)
    require_flag("replace", replace)


def _train(
    config, folder, progress, budget, engine, state_only, replace, changeable=()
) -> Agent | None:
    """`train`, with settings that may differ from those of the run in the folder."""
    max_steps, max_seconds = budget
    folder = chosen_folder(folder, config.name)
    if max_steps is not None and max_steps < config.batch:
        raise ValueError(
            f"max_steps is {max_steps}; one iteration is {config.batch} steps: give at least as "
            "many, or a configuration with fewer environments"
        )
    # At once: the trainer, which looks again, takes a while to compile.
    require_own_config(folder, config, tuple(changeable))
    for robot in config.robots:  # an unknown one is refused before anything is announced
        find(located(robot))
    announce(engine, len(config.robots), progress)
    trainer = Trainer(config, folder, engine)
    # From reading the state to saving the agent: what another call has written meanwhile would be
    # lost.
    with trainer.alone():
        trainer.start(tuple(changeable))
        begun = trainer.steps
        trains = begun < trainer.last_iteration(max_steps) * config.batch
        if trains and not (state_only or replace):
            others = (
                ", state_only=True (--state-only) to leave it, or choose another name or folder"
            )
            require_replaceable(trainer.folder, begun, others)
        run_or_interrupt(trainer, progress, max_steps, max_seconds)
        if trainer.steps > begun:
            trainer.save_portable()
            if progress and (finding := trainer.diagnosis()) is not None:
                print(finding.sentence(), flush=True)
        if state_only:
            return None
        if not replace and trainer.steps == begun <= (steps_in(trainer.folder) or 0):
            return load_agent(trainer.folder)
        try:
            return trainer.save_agent()
        except KeyboardInterrupt:
            if progress:
                print("\ninterrupted: the run is saved, the agent is not: the same call saves it")
            raise


def run_or_interrupt(trainer: Trainer, progress, max_steps=None, max_seconds=None) -> None:
    """Run a trainer until the end, a budget or an interrupt (Ctrl-C).

    Raises KeyboardInterrupt if nothing was saved yet.
    """
    try:
        trainer.run(max_steps, max_seconds, progress)
    except KeyboardInterrupt:
        saved = has_run(trainer.folder)
        if progress and saved:
            print("\ninterrupted: saved, the same call continues", flush=True)
        elif progress:
            print("\ninterrupted before the first iteration: nothing was saved", flush=True)
        if not saved:
            raise
        # The learner may be an iteration ahead of the state on disk, where the next call begins.
        trainer.start()


# ---------------------------------------------------------------------- annealing


def anneal(
    name_or_folder: str | Path,
    steps: int = 1_640_000,
    last_rate: float = 2e-5,
    progress: bool = True,
    max_seconds: float | None = None,
    engine: str = "auto",
    replace: bool = False,
) -> Agent | None:
    """Save a good agent from a run that is not at its end.

    A large learning rate learns fast and leaves the policy noisy; lowering it brings a gain that
    comes only once. So a copy of the run goes on for some steps while the rate falls, and the
    agent is the copy's. The run itself stays where it is and can go on as fast as before.

    Args:
        name_or_folder: of the run, as in `continue_run`. The agent is saved there, too; the copy
            is in a folder in it until it is finished.
        steps: environment steps of the copy.
        last_rate: its learning rate at the end; linear from the run's present one.
        progress, max_seconds, engine: see `train`. A copy that was stopped is continued.
        replace: replace the agent in the folder even if it has more steps than the copy will have,
            or a critic from policy evaluation.

    Returns:
        The agent; None if the copy was stopped before its end, which leaves the old agent.

    Raises:
        ValueError: if there is no such run, its files are damaged, its rate is below `last_rate`,
            the agent in the folder has more steps or a critic from policy evaluation, or the copy
            that was stopped is of another step of the run or has other settings.
    """
    require_integer("steps", steps, 1, MOST_STEPS)
    require_number("last_rate", last_rate, 0)
    require_engine("engine", engine)
    require_budget(None, max_seconds, progress)
    require_flag("replace", replace)
    folder = run_folder(name_or_folder)
    copy = folder / "annealed"
    engine = run_engine(folder, engine)
    config = _begin_annealing(folder, copy, steps, last_rate, replace)
    announce(engine, len(config.robots), progress)
    trainer = Trainer(config, copy, engine)
    with trainer.alone():
        trainer.start()
        run_or_interrupt(trainer, progress, max_seconds=max_seconds)
        if trainer.steps < config.iterations * config.batch:
            return None
        agent = trainer.save_agent(folder)
        # Renamed first: if this call is killed while it removes the copy, the rest of it must not
        # look like a copy that can be continued.
        finished = folder / f".annealed.{secrets.token_hex(4)}.tmp"
        os.replace(copy, finished)
    for leftover in folder.glob(".annealed.*.tmp"):
        shutil.rmtree(leftover, ignore_errors=True)
    return agent


def _begin_annealing(
    folder: Path, copy: Path, steps: int, last_rate: float, replace: bool
) -> TrainConfig:
    """Copy a run's files, with a new phase: `steps` more, and a rate that falls to `last_rate`.

    A copy that is there already stays. Returns the configuration of the new phase.
    """
    origin = saved_state(folder) or folder / STATE
    missing = [path.name for path in (origin, folder / PHASES, folder / CURVE) if not path.exists()]
    if missing:
        raise ValueError(f"there is no run to anneal in {folder}: {missing[0]} is missing")
    # The state is read first: curve rows that are newer than it do no harm.
    state = origin.read_bytes()
    done, phases = finished_iterations(folder), read_phases(folder)
    read_config(folder)  # a check: the copy's configuration is made of what was written
    config = dict(phases[-1]["config"])
    batch = config["num_envs"] * config["rollout_length"]
    first, last = config["learning_rate"]
    total = config["total_steps"] // batch
    rate = first + (last - first) * min(done / max(total, 1), 1.0)
    if last_rate > rate:
        raise ValueError(
            f"last_rate is {last_rate:g}, above the present rate of the run, {rate:g}: give a "
            "lower one"
        )
    more = max(1, round(steps / batch))
    # Linear over the whole run, through the present rate now and the last one at the end.
    slope = (last_rate - rate) / more
    config |= {
        "total_steps": (done + more) * batch,
        "learning_rate": [rate - slope * done, last_rate],
    }
    if not replace:
        require_replaceable(folder, config["total_steps"])
    phases.append({"from_step": done * batch, "config": config})
    if has_run(copy):
        delete = "delete that folder to begin anew"
        if read_json(copy / PHASES, delete) != phases:
            raise ValueError(
                f"{copy} is from an annealing that was stopped, of another step of the run or with "
                "other steps or rate; delete that folder to begin anew"
            )
    else:
        atomic_write(copy / PHASES, json.dumps(phases, indent=1) + "\n")
        atomic_write(copy / CURVE, (folder / CURVE).read_bytes())
        # The state comes last: a copy without it is made again.
        atomic_write(copy / origin.name, state)
    return from_json(TrainConfig, config)
