"""Trained agents on disk. No pickle; the files of an agent are replaced together, or none is.

An agent is a folder:

    weights.safetensors   policy and critic, float32, keys such as "policy/params/core/layer_0/bias"
    agent.json            network configurations, robots, padding, metadata, hashes
    states.npz            the state bank (absent if the agent has none)
    curve.csv             the learning curve (absent if it was not recorded)

`agent.json` holds SHA-256 hashes of weights, states and the network configurations, so that a file
that was cut off, edited or left over from another agent is noticed. For the moment of a save, new
files may lie in a folder `.agent.new` beside the old ones (`files.replace_together`).
"""

from __future__ import annotations

import csv
import dataclasses
import difflib
import functools
import hashlib
import io
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import safetensors.numpy

from shapebody.agent.agent import Agent, _flat_states, _flat_weights, _flatten, _hash, require_agent
from shapebody.arguments import require_kind, require_list, require_name, require_path, shown
from shapebody.configuration import from_json
from shapebody.design.descriptions import Sizes
from shapebody.files import PENDING, current, data_dir, read_curve, replace_together, settle
from shapebody.networks.config import CriticConfig, PolicyConfig
from shapebody.networks.critic import Critic
from shapebody.networks.inputs import (
    FOOT_OBSERVATION,
    GENERAL,
    JOINT_OBSERVATION,
    PRIVILEGED,
    initialize,
)
from shapebody.networks.policy import Policy
from shapebody.provenance import provenance
from shapebody.stored import (
    ARRAYS_LIMIT,
    read_json,
    read_npz,
    read_safetensors,
    require_regular_file,
)
from shapebody.task.observations import Observation

FORMAT = 1

WIDTH_LIMIT, LAYER_LIMIT, PART_LIMIT = 65_536, 64, 10_000
"""Largest width and number of layers of a network, and largest number of joints, feet or spheres:
far beyond what can be trained, and small enough to be refused before memory runs out."""

WEIGHTS, DESCRIPTION, STATES, CURVE = "weights.safetensors", "agent.json", "states.npz", "curve.csv"

_CONFIGURATION = ("robots", "sizes", "policy_config", "critic_config")

_OTHERS = ("name", "hash", "states_hash", "configuration_hash", "metadata")


def chosen_folder(folder, name: str) -> Path:
    """The folder that is given, or `data/checkpoints/<name>` if that is None."""
    if folder is None:
        return data_dir() / "checkpoints" / require_name("name", name)
    return require_path("folder", folder)


def _curve_rows(curve) -> list:
    """The rows of a learning curve; ValueError if they are none."""
    rows = require_list("curve", curve)
    for number, row in enumerate(rows):
        require_kind(f"row {number} of curve", row, Mapping, "a dictionary by column")
    return rows


def agents() -> list[str]:
    """Names of the agents in `data/checkpoints`, sorted."""
    folder = data_dir() / "checkpoints"
    found = [path.parent for path in folder.glob(f"*/{DESCRIPTION}")]
    found += [path.parent.parent for path in folder.glob(f"*/{PENDING}/{DESCRIPTION}")]
    return sorted({path.name for path in found})


def save_agent(
    agent: Agent,
    folder: str | Path | None = None,
    curve: Sequence[Mapping[str, Any]] | None = None,
) -> Path:
    """Write an agent and return its folder.

    An interruption, even a kill at any moment, leaves the agent that was there or the new one.

    Args:
        agent: the agent; versions, commit and machine are added to its metadata where missing.
        folder: where to write; `data/checkpoints/<name>` if not given.
        curve: rows of the learning curve, written to curve.csv; if not given, an existing
            curve.csv is left as it is.

    Raises:
        ValueError: if shapes do not fit the configurations, or metadata cannot be written as JSON.
    """
    check_agent(agent)
    folder = chosen_folder(folder, agent.name)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"folder is {str(folder)!r}, a file; give the name of a folder")
    curve = None if curve is None else _curve_rows(curve)
    weights = _flat_weights(agent)
    states = _flat_states(agent)
    configuration = {
        "robots": list(agent.robots),
        "sizes": dataclasses.asdict(agent.sizes),
        "policy_config": dataclasses.asdict(agent.policy_config),
        "critic_config": dataclasses.asdict(agent.critic_config),
    }
    document = {
        "format": FORMAT,
        "name": agent.name,
        **configuration,
        "configuration_hash": _text_hash(configuration),
        "hash": _hash(weights),
        "states_hash": None if states is None else _hash(states),
        "metadata": {**provenance(), **agent.metadata},
    }
    try:
        text = json.dumps(document, indent=1, default=_plain, allow_nan=False) + "\n"
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"metadata of agent {agent.name!r} cannot be written as JSON ({error}); use numbers, "
            "strings, lists and dictionaries, and None instead of NaN"
        ) from error
    files = {WEIGHTS: safetensors.numpy.save(weights)}
    if states is not None:
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **states)
        files[STATES] = buffer.getvalue()
    if curve is not None:
        files[CURVE] = _csv(curve)
    files[DESCRIPTION] = text
    replace_together(folder, files, removed=() if states is not None else (STATES,))
    return folder


def load_agent(name_or_folder: str | Path) -> Agent:
    """Load an agent by name from `data/checkpoints`, or from a folder.

    A Path, or a string with a path separator in it, is a folder; any other string is a name. An
    agent that is loaded by name has that name, whatever its file says: it may be a copy.

    Raises:
        ValueError: for an unknown name (the known ones are listed); for files that are cut off,
            edited, of another version or do not fit together.
        FileNotFoundError: for a missing folder or file.
    """
    folder = agent_folder(name_or_folder)
    settle(folder)
    while True:
        before = _seen(folder)
        try:
            agent = _load(folder)
            break
        except (ValueError, FileNotFoundError):
            # Files of two agents do not fit, if another process has saved one in between.
            if _seen(folder) == before:
                raise
    known = folder.parent == data_dir() / "checkpoints"
    return dataclasses.replace(agent, name=folder.name) if known else agent


def _seen(folder: Path):
    """What changes whenever an agent is saved in a folder."""
    try:
        status = current(folder, DESCRIPTION).stat()
        return status.st_ino, status.st_mtime_ns, status.st_size
    except FileNotFoundError:
        return None


def _load(folder: Path) -> Agent:
    document = _read_description(folder)
    restore = _restore(folder)
    try:
        missing = [x for x in (*_CONFIGURATION, *_OTHERS) if x not in document]
        if missing:
            raise ValueError(f"{missing[0]} is missing")
        sizes = from_json(Sizes, document["sizes"], "sizes")
        policy_config = from_json(PolicyConfig, document["policy_config"], "policy_config")
        critic_config = from_json(CriticConfig, document["critic_config"], "critic_config")
        name, robots, metadata = (document[x] for x in ("name", "robots", "metadata"))
        require_name("name", name)
        if not isinstance(robots, list) or not all(isinstance(x, str) and x for x in robots):
            raise ValueError(f"robots is {shown(robots)}; expected a list of names")
        for kind in ("hash", "states_hash", "configuration_hash"):
            if not isinstance(document[kind], str | None if kind == "states_hash" else str):
                raise ValueError(f"{kind} is {shown(document[kind])}; expected a text")
        _check_metadata(metadata)
        _check_sizes(sizes, policy_config, critic_config)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{folder / DESCRIPTION} is not a valid agent description ({error}); {restore}"
        ) from error

    modules = {"policy": Policy(policy_config), "critic": Critic(critic_config)}

    def check(header):
        for role, module in modules.items():
            own = {k.removeprefix(f"{role}/"): v for k, v in header.items() if k.startswith(role)}
            shapes = {k: shape for k, (shape, _) in own.items()}
            _check_shapes(shapes, _expected(module), f"{folder / WEIGHTS} ({role})", restore)
        for key, (_, dtype) in header.items():
            if dtype != np.float32 or not key.startswith(tuple(modules)):
                raise ValueError(
                    f"{folder / WEIGHTS} has {shown(key)} of type {dtype}, expected float32 "
                    f"numbers of {' and '.join(modules)} alone; {restore}"
                )

    weights = read_safetensors(current(folder, WEIGHTS), restore, check)
    variables = {
        role: _nest({k.removeprefix(f"{role}/"): v for k, v in weights.items() if k[:6] == role})
        for role in modules
    }
    if _hash(weights) != document["hash"]:
        raise ValueError(
            f"{folder / WEIGHTS} does not match the hash in {DESCRIPTION}: it was edited or "
            f"belongs to another agent; {restore}"
        )
    states_hash = document["states_hash"]
    states, state_robots = None, None
    if states_hash is None and current(folder, STATES).exists():
        raise ValueError(
            f"{DESCRIPTION} says that the agent has no state bank, but there is {folder / STATES}: "
            f"{DESCRIPTION} was edited, or the other file is of another agent; {restore}"
        )
    if states_hash is not None:
        arrays = read_npz(current(folder, STATES), _state_shapes(sizes), restore)
        if _hash(arrays) != states_hash:
            raise ValueError(
                f"{folder / STATES} does not match the hash in {DESCRIPTION}: it was edited or "
                f"belongs to another agent; {restore}"
            )
        state_robots = arrays.pop("state_robots")
        states = Observation(**arrays)
    agent = Agent(
        name=name,
        robots=tuple(robots),
        sizes=sizes,
        policy_config=policy_config,
        critic_config=critic_config,
        policy=variables["policy"],
        critic=variables["critic"],
        states=states,
        state_robots=state_robots,
        metadata=metadata,
    )
    try:
        check_agent(agent)
    except ValueError as error:
        raise ValueError(
            f"the files in {folder} do not fit together: {error}; {restore}"
        ) from error
    # Other settings of the same shapes would make other networks of the same weights.
    stored = {name: document[name] for name in _CONFIGURATION}
    if _text_hash(stored) != document["configuration_hash"]:
        raise ValueError(
            f"{', '.join(_CONFIGURATION)} in {folder / DESCRIPTION} do not match their hash: the "
            f"file was edited; {restore}"
        )
    return agent


def load_curve(name_or_folder: str | Path) -> dict[str, np.ndarray]:
    """Columns of an agent's learning curve (`files.read_curve`).

    Raises FileNotFoundError if the agent has none.
    """
    path = current(agent_folder(name_or_folder), CURVE)
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist: this agent has no learning curve")
    return read_curve(path)


def check_agent(agent: Agent) -> None:
    """Raise ValueError if the parts of an agent do not fit together, or are too large."""
    require_agent(agent)
    require_name("the name of the agent", agent.name)
    _check_sizes(agent.sizes, agent.policy_config, agent.critic_config)
    if not agent.robots:
        raise ValueError(f"agent {agent.name!r} names no robots; give at least one")
    for role, module, variables in (
        ("policy", agent.policy_module, agent.policy),
        ("critic", agent.critic_module, agent.critic),
    ):
        flat = {name: np.shape(x) for name, x in _flatten(variables).items()}
        fix = f"initialize the {role} with its own configuration"
        _check_shapes(flat, _expected(module), f"{role} of agent {agent.name!r}", fix)
    if agent.states is None:
        return
    count, total = agent.num_states, 0
    for name, (shape, dtype) in _state_shapes(agent.sizes).items():
        shape = (count, *shape[1:])
        total += math.prod(shape) * np.dtype(dtype).itemsize
        found = np.shape(getattr(agent.states, name, agent.state_robots))
        if (found != shape or count == 0) and name != "state_robots":
            raise ValueError(
                f"states.{name} of agent {agent.name!r} has shape {found}, expected {shape} with "
                "at least one state; pad observations to the agent's sizes"
            )
    if total > ARRAYS_LIMIT:
        raise ValueError(
            f"the state bank of agent {agent.name!r} has {total:,} bytes, expected at most "
            f"{ARRAYS_LIMIT:,}; keep fewer states"
        )
    owners = agent.state_robots
    if (
        np.shape(owners) != (count,)
        or np.min(owners) < 0
        or np.max(owners) >= len(agent.robots)
        or not np.issubdtype(np.asarray(owners).dtype, np.integer)
    ):
        raise ValueError(
            f"state_robots of agent {agent.name!r} must be {count} integers from 0 to "
            f"{len(agent.robots) - 1}, one per state: the index of its robot in agent.robots"
        )


def agent_folder(name_or_folder: str | Path) -> Path:
    """The folder of an agent that is given as in `load_agent`; raises what that raises."""
    folder = require_path("agent", name_or_folder)
    text = str(name_or_folder)
    if isinstance(name_or_folder, Path) or os.sep in text or "/" in text:
        if not folder.is_dir():
            raise FileNotFoundError(
                f"agent folder {shown(text)} does not exist (looked at {folder.absolute()}): give "
                "an existing folder, or one of the names of shapebody.agent.store.agents()"
            )
        return folder
    known = agents()
    if text not in known:
        close = difflib.get_close_matches(text[:100], known, n=1)
        hint = f"; did you mean {close[0]!r}?" if close else "."
        listing = ", ".join(known) if known else "none"
        raise ValueError(
            f"there is no agent {shown(text)} in {data_dir() / 'checkpoints'}{hint} "
            f"Available agents: {listing}"
        )
    return data_dir() / "checkpoints" / text


def read_metadata(folder: Path) -> dict | None:
    """Metadata of the agent in a folder without its arrays; None if there is no agent.

    Raises ValueError if its description is damaged.
    """
    path = current(folder, DESCRIPTION)
    if not path.exists():
        return None
    restore = _restore(folder)
    # Of any format: what later ones hold of this is as likely the same.
    document = read_json(path, restore)
    metadata = document.get("metadata") if isinstance(document, dict) else None
    try:
        _check_metadata(metadata)
    except ValueError as error:
        raise ValueError(f"{path} is not a valid agent description ({error}); {restore}") from error
    return metadata


def _restore(folder: Path) -> str:
    return f"restore the folder, for example with 'git checkout -- {folder}', or train anew"


def _read_description(folder: Path) -> dict:
    path = current(folder, DESCRIPTION)
    require_regular_file(path, f"{folder} is no agent, or its files were copied incompletely")
    restore = _restore(folder)
    try:
        document = read_json(path, restore)
        if not isinstance(document, dict) or "format" not in document:
            raise ValueError(f"it holds {shown(document)} without a format; {restore}")
    except ValueError as error:
        raise ValueError(f"{path} is not a valid agent description: {error}") from error
    number = document["format"]
    if number != FORMAT:
        raise ValueError(
            f"{path} has format {shown(number)}, expected {FORMAT}; use the version of "
            "shapebody that wrote it, or train anew"
        )
    return document


_METADATA = {
    "steps": (int, "an integer"),
    "scale": (str, "a text"),
    "engine": (str, "a text"),
    "seconds": (int | float, "a number"),
    "config": (dict, "an object"),
    "phases": (list, "a list of objects"),
    "policy_evaluation": (dict, "an object"),
}
"""Metadata that other parts of the package read: their kinds, where they are given."""


def _check_metadata(metadata) -> None:
    """ValueError if what other parts of the package read there is of another kind."""

    def check(values, what):
        if not isinstance(values, dict):
            raise ValueError(f"{what} is {shown(values)}; expected an object")
        for name, (kind, words) in _METADATA.items():
            value = values.get(name)
            if name in values and (not isinstance(value, kind) or isinstance(value, bool)):
                raise ValueError(f"{what}.{name} is {shown(value)}; expected {words}")

    check(metadata, "metadata")
    check(metadata.get("policy_evaluation", {}), "metadata.policy_evaluation")
    robots = metadata.get("config", {}).get("robots", ["?"])
    if not (isinstance(robots, list) and robots and all(isinstance(x, str) for x in robots)):
        raise ValueError(f"metadata.config.robots is {shown(robots)}; expected a list of names")
    for phase in metadata.get("phases", []):
        if not isinstance(phase, dict) or not isinstance(phase.get("robots", {}), dict):
            raise ValueError(f"metadata.phases has {shown(phase)}; expected objects")


def _check_sizes(sizes: Sizes, policy: PolicyConfig, critic: CriticConfig) -> None:
    """ValueError for numbers that no network or robot has: memory would run out first."""
    for what, one, most in (
        ("sizes", sizes, PART_LIMIT),
        ("policy_config", policy, WIDTH_LIMIT),
        ("critic_config", critic, WIDTH_LIMIT),
    ):
        for name, value in dataclasses.asdict(one).items():
            limit = LAYER_LIMIT if name == "heads" else most
            values = value if name.endswith("widths") else (value,)
            if len(values) > LAYER_LIMIT:
                raise ValueError(f"{what}.{name} has {len(values)} layers, at most {LAYER_LIMIT}")
            for x in values:
                if isinstance(x, int | np.integer) and not 0 <= x <= limit:
                    raise ValueError(f"{what}.{name} is {x}; expected 0 to {limit:,}")


def _state_shapes(sizes: Sizes) -> dict[str, tuple]:
    """Shapes (with None for the number of states) and types of a state bank's arrays."""
    return {
        "joints": ((None, sizes.joints, JOINT_OBSERVATION), "float32"),
        "feet": ((None, sizes.feet, FOOT_OBSERVATION), "float32"),
        "general": ((None, GENERAL), "float32"),
        "privileged": ((None, PRIVILEGED), "float32"),
        "state_robots": ((None,), "int32"),
    }


def _nest(flat: Mapping[str, Any]) -> dict:
    tree: dict = {}
    for name, value in flat.items():
        *path, last = name.split("/")
        node = tree
        for key in path:
            node = node.setdefault(key, {})
        node[last] = value
    return tree


@functools.lru_cache
def _expected(module) -> dict[str, tuple[int, ...]]:
    """Shapes of freshly initialized variables, by flat name."""
    variables = jax.eval_shape(lambda: initialize(module, jax.random.key(0)))
    return {name: leaf.shape for name, leaf in _flatten(variables).items()}


def _check_shapes(
    shapes: Mapping[str, tuple], expected: Mapping[str, tuple], what: str, fix: str
) -> None:
    problems = [f"{name} is missing" for name in expected if name not in shapes]
    problems += [f"{shown(name)} is unknown" for name in shapes if name not in expected]
    problems += [
        f"{name} has shape {shown(shapes[name])}, expected {shape}"
        for name, shape in expected.items()
        if name in shapes and shapes[name] != shape
    ]
    if problems:
        more = f" and {len(problems) - 3} more" if len(problems) > 3 else ""
        raise ValueError(
            f"{what} does not fit its configuration: {'; '.join(problems[:3])}{more}; {fix}"
        )


def _text_hash(document: dict) -> str:
    """SHA-256 of a JSON document, independent of the order of its keys."""
    text = json.dumps(document, sort_keys=True, default=_plain)
    return hashlib.sha256(text.encode()).hexdigest()


def _csv(rows: Sequence[Mapping[str, Any]]) -> str:
    columns = list(dict.fromkeys(name for row in rows for name in row))
    file = io.StringIO(newline="")
    writer = csv.DictWriter(file, columns, lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({k: _plain(v) if hasattr(v, "shape") else v for k, v in row.items()})
    return file.getvalue()


def _plain(value):
    """JSON form of what the standard encoder does not know."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if hasattr(value, "tolist"):
        return np.asarray(value).tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} is not JSON")
