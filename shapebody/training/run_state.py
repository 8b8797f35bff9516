"""A run on disk: what it was begun with, and whether a configuration continues it.

The files of a run, in its folder:

    training.safetensors           everything that determines its future
    training.portable.safetensors  the same in small, without the episodes (`portable`)
    training.json                  its configuration
    training.csv                   its learning curve

Shipped runs have the second of them only, and go on with new episodes; from then on they have the
first one, which wins.

One rule: a run is continued with its own configuration, and any other configuration is another run
with another name. `train.continue_run` takes the configuration from training.json, and is the only
way to override a setting.

training.json is a list of phases, whose last one has the configuration of the run. There is more
than one where settings were overridden, or where the run is a copy that is annealed. The first
phase also has the hashes of the robots' files and the name of the engine.
"""

import os
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from pydantic import Field

from shapebody.agent.description import Phase
from shapebody.agent.store import chosen_folder
from shapebody.arguments import (
    require_engine,
    require_flag,
    require_integer,
    require_kind,
    require_number,
    require_path,
)
from shapebody.configuration import configuration, from_json, to_json
from shapebody.stored import read_json, read_number
from shapebody.training.config import MOST_STEPS, TrainConfig, robot_name

STATE, PHASES, CURVE = "training.safetensors", "training.json", "training.csv"
PORTABLE = "training.portable.safetensors"

ANEW = f"restore it, or delete {STATE} beside it to begin anew"
"""What to do about a damaged file of a run."""


# ---------------------------------------------------------------------- arguments


def require_run(config, engine: str = "auto") -> None:
    """TypeError if `config` is not a `TrainConfig`, ValueError for an unknown engine."""
    hint = 'for example TrainConfig.reduced("unitree_go2")'
    require_kind("config", config, TrainConfig, hint)
    require_engine("engine", engine)


def require_budget(max_steps, max_seconds, progress) -> None:
    """ValueError if one of these arguments of a training is not what it should be."""
    if max_steps is not None:
        require_integer("max_steps", max_steps, 0, MOST_STEPS)
    if max_seconds is not None:
        require_number("max_seconds", max_seconds, 0)
    require_flag("progress", progress)


# ---------------------------------------------------------------------- reading


def run_folder(name_or_folder: str | Path) -> Path:
    """The folder of a run: data/checkpoints/<name>, or the folder that is given.

    A Path, or a string with a path separator in it, is a folder; any other string is a name.
    """
    path = require_path("name_or_folder", name_or_folder)
    text = str(name_or_folder)
    if isinstance(name_or_folder, Path) or os.sep in text or "/" in text:
        return path
    return chosen_folder(None, text)


def state_version(folder: Path):
    """What changes whenever the state in a folder is written; None where there is none."""
    try:
        status = (folder / STATE).stat()
        return status.st_ino, status.st_mtime_ns, status.st_size
    except FileNotFoundError:
        return None


def saved_state(folder: Path) -> Path | None:
    """The state of the run in a folder, the exact one if there are both; None without a run."""
    paths = (folder / STATE, folder / PORTABLE)
    return next((path for path in paths if path.exists()), None)


def has_run(folder: Path) -> bool:
    """Whether there is a run in a folder."""
    return saved_state(folder) is not None


def finished_iterations(folder: Path) -> int:
    """Finished iterations of the run in a folder; ValueError if its state is damaged."""
    path = saved_state(folder) or folder / STATE
    fix = "restore it, or delete it to begin anew"
    number = read_number(path, "learner/iteration", fix)
    if number < 0:
        raise ValueError(f"{path} is damaged: it has {number} iterations; {fix}")
    return number


@configuration
class RunFile:
    """The contents of training.json."""

    phases: Annotated[list[Phase], Field(min_length=1)]


def read_phases(folder: Path) -> list[dict]:
    """The phases of the run in a folder, as its training.json holds them.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if it is damaged.
    """
    try:
        phases = read_json(folder / PHASES, ANEW)
        from_json(RunFile, {"phases": phases}, PHASES)
    except ValueError as error:
        raise ValueError(
            f"{PHASES} is missing or damaged ({error}); it says how the run in {folder} was "
            f"configured: {ANEW}"
        ) from error
    return phases


def read_config(folder: Path) -> TrainConfig:
    """The configuration of the run in a folder.

    Settings that are newer than the run have their defaults.

    Raises:
        FileNotFoundError: if there is no run, or its training.json is missing.
        ValueError: if that is damaged, or has settings that this version does not know.
    """
    if not has_run(folder):
        raise FileNotFoundError(
            f"there is no run in {folder}: {STATE} is missing; begin one with "
            "`python -m shapebody train` or shapebody.train(...)"
        )
    try:
        return from_json(TrainConfig, read_phases(folder)[-1].get("config"), "config")
    except ValueError as error:
        raise ValueError(
            f"{PHASES} of the run in {folder} is damaged, or has settings that this version of "
            f"shapebody does not know ({error}); continue it with the version that began it, or "
            f"{ANEW}"
        ) from error


def run_engine(folder: Path, engine: str) -> str:
    """The engine for a run in a folder: that of the run there, or `engine` if there is none.

    Raises:
        ValueError: if the run there has another engine than `engine`, unless that is "auto".
    """
    if not has_run(folder):
        return engine
    try:
        own = read_phases(folder)[0].get("engine", "native")
    except (OSError, ValueError):
        return engine  # a damaged file, which `Trainer.start` reports
    if engine not in ("auto", own):
        raise ValueError(
            f"engine is {engine!r}, but the run in {folder.name} was begun with {own!r}, whose "
            f"physics state no other engine can read: continue it with 'auto' or {own!r}, or begin "
            "a run under another name"
        )
    return own


# ---------------------------------------------------------------------- continuing


def require_own_config(
    folder: Path, config: TrainConfig, changeable: Collection[str] = ()
) -> list[str]:
    """Refuse a configuration that is not that of the run in a folder, if there is one.

    Args:
        folder: of the run.
        config: the configuration. Robots whose files have only moved are the same ones.
        changeable: names of settings that may differ from those of the run.

    Returns:
        Names of the settings that do.

    Raises:
        FileNotFoundError: if the run's training.json is missing.
        ValueError: if another setting differs, or training.json is damaged.
    """
    if not has_run(folder):
        return []
    last = read_config(folder)
    own, robots = ([robot_name(robot) for robot in x.robots] for x in (last, config))
    if own == robots:
        last = replace(last, robots=config.robots)  # `require_same_robots` compares their files
    before, now = to_json(last), to_json(config)
    different = [name for name in now if before[name] != now[name]]
    other = [name for name in different if name not in changeable or name == "robots"]
    if other:
        text = "; ".join(_difference(name, before[name], now[name]) for name in other)
        raise ValueError(
            f"the run in {folder.name} has another configuration ({text}); continue it with its "
            f"own (train.continue_run, python -m shapebody continue {folder.name}), choose another "
            f"name for this one, or delete {STATE} there to begin anew"
        )
    return different


def continued_phases(
    folder: Path, config: TrainConfig, steps: int, robots, changeable: Collection[str] = ()
) -> list[dict]:
    """The phases of the run in a folder, which goes on with `config` after `steps` steps.

    A phase is added if one of the `changeable` settings differs. Raises what `require_own_config`
    raises, and ValueError if the file of one of the `robots` is not that of the run.
    """
    different = require_own_config(folder, config, changeable)
    phases = read_phases(folder)
    require_same_robots(phases[0].get("robots", {}), robots, f"the run in {folder.name}")
    return phases + [{"from_step": steps, "config": to_json(config)}] if different else phases


def require_same_robots(known: dict, robots, what: str) -> None:
    """ValueError if the file of a robot is not the one whose hash was recorded."""
    changed = [robot.name for robot in robots if known.get(robot.name, robot.hash) != robot.hash]
    if changed:
        raise ValueError(
            f"the file of robot {', '.join(changed)} has changed since {what} began, or is another "
            "one of that name; put the old file back, or train under another name"
        )


def _difference(name: str, old, new) -> str:
    """How a setting differs, in words; of nested settings, each that does."""
    if isinstance(old, dict) and isinstance(new, dict):
        inside = [key for key in new if old.get(key) != new[key]]
        return "; ".join(_difference(f"{name}.{key}", old.get(key), new[key]) for key in inside)
    return f"{name} was {old!r}, is {new!r}"
