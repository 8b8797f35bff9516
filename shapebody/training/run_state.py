"""A run on disk: what it was begun with, and whether a configuration continues it."""

from dataclasses import replace
from pathlib import Path

from shapebody.agent.store import chosen_folder
from shapebody.arguments import (
    require_engine,
    require_flag,
    require_integer,
    require_kind,
    require_number,
    shown,
)
from shapebody.configuration import from_json, to_json
from shapebody.stored import read_json, read_number
from shapebody.training.config import MOST_STEPS, TrainConfig, located, robot_name


def _version(folder: Path):
    """What changes whenever the state in a folder is written; None where there is none."""
    try:
        status = (folder / "training.safetensors").stat()
        return status.st_ino, status.st_mtime_ns, status.st_size
    except FileNotFoundError:
        return None


STATE_FILES = ("training.safetensors", "training.json", "training.csv")
"""A run in its folder: its state, its configurations and its learning curve."""


def _require_run(config, engine: str = "auto") -> None:
    hint = 'for example TrainConfig.reduced("unitree_go2")'
    require_kind("config", config, TrainConfig, hint)
    require_engine("engine", engine)


def _require_budget(max_steps, max_seconds, progress) -> None:
    if max_steps is not None:
        require_integer("max_steps", max_steps, 0, MOST_STEPS)
    if max_seconds is not None:
        require_number("max_seconds", max_seconds, 0)
    require_flag("progress", progress)


CHANGEABLE = (
    "total_steps",
    "epochs",
    "minibatch_size",
    "learning_rate",
    "entropy_coefficient",
    "value_lambda",
    "cut_at_commands",
    "state_bank",
)
"""Fields that may change when a run is continued; each change is recorded."""

CHANGEABLE_INSIDE = {"policy": ("std_limits",), "task": ("horizon", "curriculum_length")}
"""What may change inside other fields: the limits of the exploration noise, and the lengths of
episodes (those that are under way keep theirs)."""


def as_continued(config: TrainConfig, folder=None) -> TrainConfig:
    """The configuration of the run in the folder of `config`, if there is one to continue.

    `config` itself if there is none, or one of other robots or of another scale. So a run goes on
    with the settings that it was begun with, whatever the defaults are now. To change one that may
    change (`CHANGEABLE`, `CHANGEABLE_INSIDE`), replace it in the result.
    """
    _require_run(config)
    folder = chosen_folder(folder, config.name)
    if not (folder / "training.safetensors").exists():
        return config
    try:
        last = from_json(TrainConfig, _phases(folder / "training.json")[-1].get("config"))
    except (OSError, ValueError):
        return config  # nothing to continue, or a damaged file, which `Trainer.start` reports

    def identity(config):
        return config.name, [robot_name(robot) for robot in config.robots], config.scale

    # Their files may have moved; `Trainer.start` compares them with those of the run.
    return replace(last, robots=config.robots) if identity(last) == identity(config) else config


ANEW = "restore it, or delete training.safetensors beside it to begin anew"
"""What to do about a damaged file of a run."""


def _iterations(folder: Path) -> int:
    """Finished iterations of the run in a folder."""
    path = folder / "training.safetensors"
    fix = "restore it, or delete it to begin anew"
    number = read_number(path, "learner/iteration", fix)
    if number < 0:
        raise ValueError(f"{path} is damaged: it has {number} iterations; {fix}")
    return number


def _phases(path: Path) -> list[dict]:
    """The phases of a run, as its training.json holds them (`_continued`).

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if it is damaged.
    """
    try:
        phases = read_json(path, ANEW)
        if not isinstance(phases, list) or not phases:
            raise ValueError("it holds no phases")
        kinds = {"config": dict, "from_step": int, "robots": dict, "engine": str}
        for phase in phases:
            if not isinstance(phase, dict):
                raise ValueError("a phase is no object")
            for name, kind in kinds.items():
                if not isinstance(phase.get(name, kind()), kind):
                    raise ValueError(f"{name} of a phase is of another kind than {kind.__name__}")
            if phase.get("engine", "native") not in ("native", "mjx"):
                raise ValueError(f"the engine is {shown(phase['engine'])}")
    except ValueError as error:
        raise ValueError(
            f"{path.name} is missing or damaged ({error}); it says how the run in {path.parent} "
            f"was configured: {ANEW}"
        ) from error
    return phases


def _engine(folder: Path, engine: str) -> str:
    """The engine for a run in a folder: that of the run there, or `engine` if there is none.

    Raises:
        ValueError: if the run there has another engine than `engine`, which is not "auto".
    """
    if not (folder / "training.safetensors").exists():
        return engine
    try:
        # A run that does not say so is older than the record and native.
        own = _phases(folder / "training.json")[0].get("engine", "native")
    except (OSError, ValueError):
        return engine  # a damaged file, which `Trainer.start` reports
    if engine not in ("auto", own):
        raise ValueError(
            f"engine is {engine!r}, but the run in {folder.name} was begun with {own!r}, whose "
            f"physics state no other engine can read: continue it with 'auto' or {own!r}, or begin "
            "a run under another name"
        )
    return own


def _continued(path: Path, config: TrainConfig, steps: int, robots=()) -> list[dict]:
    """The phases of a run that goes on with `config`: a list of {"from_step", "config"}, the first
    with hashes of the robots' files and the name of the engine.

    Raises:
        ValueError: if more than what is changeable, or a robot's file, differs from the run in
            `path`.
    """
    phases = _phases(path)
    try:
        # Settings that are newer than the run are at their defaults in it.
        last = from_json(TrainConfig, phases[-1].get("config"), "config")
    except ValueError as error:
        raise ValueError(
            f"{path.name} of the run in {path.parent} is damaged, or has settings that this "
            f"version of shapebody does not know ({error}); continue it with the version that "
            f"began it, or {ANEW}"
        ) from error
    before = to_json(replace(last, robots=tuple(located(robot) for robot in last.robots)))
    known = phases[0].get("robots", {})
    if [r.name for r in robots] == [robot_name(r) for r in last.robots] and all(
        r.name in known for r in robots
    ):
        # Files that have only moved are the same robots: their hashes are compared below.
        before["robots"] = list(config.robots)
    now = to_json(config)
    different = [name for name in now if before.get(name) != now[name]]
    changeable = list(CHANGEABLE)
    for field_name, inside in CHANGEABLE_INSIDE.items():
        new = {name: now[field_name][name] for name in inside}
        if before[field_name] | new == now[field_name]:
            changeable.append(field_name)
    other = [name for name in different if name not in changeable]
    if other:
        text = "; ".join(_difference(name, before.get(name), now[name]) for name in other)
        raise ValueError(
            f"the run in {path.parent.name} has another configuration ({text}); continue it with "
            "the old one, which as_continued(config) of shapebody.training.run_state returns, "
            "choose another name, or delete its training.safetensors to begin anew"
        )
    _require_same_robots(known, robots, f"the run in {path.parent.name}")
    return phases + [{"from_step": steps, "config": now}] if different else phases


def _require_same_robots(known: dict, robots, what: str) -> None:
    """ValueError if the file of a robot is not the one whose hash was recorded."""
    changed = [r.name for r in robots if known.get(r.name, r.hash) != r.hash]
    if changed:
        raise ValueError(
            f"the file of robot {', '.join(changed)} has changed since {what} began, or is another "
            "one of that name; put the old file back, or train under another name"
        )


def _difference(name: str, old, new) -> str:
    if isinstance(old, dict) and isinstance(new, dict):
        inside = [key for key in new if old.get(key) != new[key]]
        return "; ".join(_difference(f"{name}.{key}", old.get(key), new[key]) for key in inside)
    return f"{name} was {old!r}, is {new!r}"
