"""Training runs from beginning to end: train, continue, anneal."""

import json
import os
import secrets
import shutil
from pathlib import Path

from shapebody.agent.agent import Agent
from shapebody.agent.store import chosen_folder, load_agent, read_metadata
from shapebody.arguments import require_engine, require_flag, require_integer, require_number
from shapebody.configuration import from_json
from shapebody.files import atomic_write
from shapebody.stored import read_json
from shapebody.training.config import MOST_STEPS, TrainConfig
from shapebody.training.run_state import (
    STATE_FILES,
    _engine,
    _iterations,
    _phases,
    _require_budget,
    _require_run,
    as_continued,
)
from shapebody.training.trainer import Trainer


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

    An interrupt (Ctrl-C) ends the call early, with the agent of the last iteration; before the
    first one there is nothing to save, and KeyboardInterrupt is raised. A call that trains nothing,
    because the run is at its end or at `max_steps`, leaves an agent of at least as many steps in
    the folder as it is, with the critic that `train_critic` may have given it.

    Args:
        config: the run, for example `TrainConfig.reduced("unitree_go2")`. If it is the default of
            its scale, a run in the folder goes on with the settings that it has (`as_continued`).
        folder: where the agent is kept; data/checkpoints/<name> by default. A run that was
            stopped there is continued exactly where it was.
        progress: print return, tracking error, curriculum coefficient, speed and time left.
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
            steps than the run that is to go on, or if the run there cannot be continued with
            `config`.
    """
    _require_run(config, engine)
    _require_budget(max_steps, max_seconds, progress)
    for name, value in (("state_only", state_only), ("replace", replace)):
        require_flag(name, value)
    given = {"robots": config.robots, "name": config.name}
    if config == TrainConfig.at_scale(config.scale, config.robots[0], **given):
        config = as_continued(config, folder)
    if max_steps is not None and max_steps < config.batch:
        raise ValueError(
            f"max_steps is {max_steps}; one iteration is {config.batch} steps: give at least as "
            "many, or a configuration with fewer environments"
        )
    trainer = Trainer(config, folder, engine)
    # From reading the state to saving the agent: what another call has written meanwhile would be
    # lost.
    with trainer.alone():
        trainer.start()
        begun = trainer.steps
        if not (state_only or replace) and begun < trainer.last_iteration(max_steps) * config.batch:
            others = (
                ", state_only=True (--state-only) to leave it, or choose another name or folder"
            )
            _keep_agent(trainer.folder, begun, others)
            _keep_critic(trainer.folder, others)
        _run(trainer, progress, max_steps, max_seconds)
        if state_only:
            return None
        if not replace and trainer.steps == begun <= (_agent_steps(trainer.folder) or 0):
            return load_agent(trainer.folder)
        return trainer.save_agent()


def _metadata(folder: Path) -> dict | None:
    """Metadata of the agent in a folder: None if there is no agent, {} if they are unreadable."""
    try:
        return read_metadata(folder)
    except (ValueError, OSError):
        return {}


def _agent_steps(folder: Path) -> int | None:
    """Steps of the agent in a folder: None if there is no agent, 0 if it does not say."""
    metadata = _metadata(folder)
    return None if metadata is None else metadata.get("steps", 0)


def _keep_agent(folder: Path, steps: int, others: str = "") -> None:
    """Raise ValueError if the agent in a folder has more steps than the one to replace it."""
    kept = _agent_steps(folder)
    # A run that is about to begin replaces no agent, not even one of unknown steps.
    if kept is not None and (kept > steps or steps == 0):
        raise ValueError(
            f"the agent in {folder} has {kept:,} steps, the run that would replace it {steps:,}; "
            f"pass replace=True (--replace) to replace it{others}"
        )


def _keep_critic(folder: Path, others: str = "") -> None:
    """Raise ValueError if the agent in a folder has a critic from policy evaluation."""
    if "policy_evaluation" in (_metadata(folder) or {}):
        raise ValueError(
            f"the agent in {folder} has a critic from policy evaluation (sharpen), which the run "
            "that would replace the agent does not have; pass replace=True (--replace) to replace "
            f"it, and sharpen it again afterwards{others}"
        )


def anneal(
    name: str,
    steps: int = 1_640_000,
    last_rate: float = 2e-5,
    folder=None,
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
        name: of the agent whose run is in data/checkpoints/<name>.
        steps: environment steps of the copy.
        last_rate: its learning rate at the end; linear from the run's present one.
        folder: of the run, instead of data/checkpoints/<name>. The agent is saved there; the copy
            is in a folder in it until it is finished.
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
    _require_budget(None, max_seconds, progress)
    require_flag("replace", replace)
    folder = chosen_folder(folder, name)
    copy = folder / "annealed"
    engine = _engine(folder, engine)
    config = _begin_annealing(folder, copy, steps, last_rate, replace)
    trainer = Trainer(config, copy, engine)
    with trainer.alone():
        trainer.start()
        _run(trainer, progress, None, max_seconds)
        if trainer.steps < config.iterations * config.batch:
            return None
        agent = trainer.save_agent(folder)
        # By renaming it first: a copy of which a killed call has removed half would be no run.
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
    missing = [file for file in STATE_FILES if not (folder / file).exists()]
    if missing:
        raise ValueError(f"there is no run to anneal in {folder.name}: {missing[0]} is missing")
    # The state is read first: curve rows that are newer than it do no harm.
    state = (folder / STATE_FILES[0]).read_bytes()
    done = _iterations(folder)
    phases = _phases(folder / "training.json")
    # Checked, but kept as it was written: the copy continues from it.
    from_json(TrainConfig, phases[-1].get("config"), f"the configuration in {folder}/training.json")
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
        _keep_agent(folder, config["total_steps"])
        _keep_critic(folder)
    phases.append({"from_step": done * batch, "config": config})
    if (copy / "training.safetensors").exists():
        delete = "delete that folder to begin anew"
        if read_json(copy / "training.json", delete) != phases:
            raise ValueError(
                f"{copy} is from an annealing that was stopped, of another step of the run or with "
                "other steps or rate; delete that folder to begin anew"
            )
    else:
        atomic_write(copy / "training.json", json.dumps(phases, indent=1) + "\n")
        atomic_write(copy / "training.csv", (folder / "training.csv").read_bytes())
        # The state comes last: a copy without it is made again.
        atomic_write(copy / "training.safetensors", state)
    return from_json(TrainConfig, config)


def _run(trainer: Trainer, progress, max_steps, max_seconds) -> None:
    """Run until the end, a budget or an interrupt; raise an interrupt before anything was saved."""
    try:
        trainer.run(max_steps, max_seconds, progress)
    except KeyboardInterrupt:
        saved = (trainer.folder / "training.safetensors").exists()
        if progress and saved:
            print("\ninterrupted: saved, the same call continues", flush=True)
        elif progress:
            print("\ninterrupted before the first iteration: nothing was saved", flush=True)
        if not saved:
            raise
        # The learner may be an iteration ahead of the state on disk, where the next call begins.
        trainer.start()
