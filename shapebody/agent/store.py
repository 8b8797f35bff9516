"""Trained agents on disk. No pickle; the files of an agent are replaced together, or none is.

An agent is a folder:

    weights.safetensors   policy and critic, float32, keys such as "policy/params/core/layer_0/bias"
    agent.json            network configurations, robots, padding, metadata, hashes (`description`)
    states.npz            the state bank (absent if the agent has none)
    curve.csv             the learning curve (absent if it was not recorded)

`agent.json` holds SHA-256 hashes of weights, states and the network configurations, so that a file
that was cut off, edited or left over from another agent is noticed. For the moment of a save, new
files may lie in a folder `.agent.new` beside the old ones (`files.replace_together`).
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import io
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import safetensors.numpy
from flax.traverse_util import flatten_dict, unflatten_dict

from shapebody.agent.agent import Agent, flat_states, flat_weights, hash_arrays, require_critic
from shapebody.agent.description import (
    DESCRIPTION,
    Description,
    description_text,
    how_to_restore,
    read_description,
)
from shapebody.arguments import require_kind, require_list, require_name, require_path, shown
from shapebody.design.descriptions import Sizes
from shapebody.files import (
    PENDING,
    current,
    curve_text,
    data_dir,
    read_curve,
    replace_together,
    settle,
)
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
from shapebody.stored import ARRAYS_LIMIT, read_npz, read_safetensors, require_arrays
from shapebody.task.observations import Observation

WEIGHTS, STATES, CURVE = "weights.safetensors", "states.npz", "curve.csv"


# ---------------------------------------------------------------------- folders


def chosen_folder(folder, name: str) -> Path:
    """The folder that is given, or `data/checkpoints/<name>` if that is None."""
    if folder is None:
        return data_dir() / "checkpoints" / require_name("name", name)
    return require_path("folder", folder)


def agents() -> list[str]:
    """Names of the agents in `data/checkpoints`, sorted."""
    folder = data_dir() / "checkpoints"
    found = [path.parent for path in folder.glob(f"*/{DESCRIPTION}")]
    found += [path.parent.parent for path in folder.glob(f"*/{PENDING}/{DESCRIPTION}")]
    return sorted({path.name for path in found})


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


# ---------------------------------------------------------------------- saving


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
    files = {WEIGHTS: safetensors.numpy.save(flat_weights(agent))}
    states = flat_states(agent)
    if states is not None:
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **states)
        files[STATES] = buffer.getvalue()
    if curve is not None:
        rows = require_list("curve", curve)
        for number, row in enumerate(rows):
            require_kind(f"row {number} of curve", row, Mapping, "a dictionary by column")
        files[CURVE] = curve_text(rows)
    files[DESCRIPTION] = description_text(agent)
    replace_together(folder, files, removed=() if states is not None else (STATES,))
    return folder


def check_agent(agent: Agent) -> None:
    """Raise ValueError if the parts of an agent do not fit together, or are too large."""
    require_critic(agent)
    require_name("the name of the agent", agent.name)
    if not agent.robots:
        raise ValueError(f"agent {agent.name!r} names no robots; give at least one")
    weights = flatten_dict({"policy": agent.policy, "critic": agent.critic}, sep="/")
    require_arrays(
        {name: (np.shape(array), np.dtype(np.float32)) for name, array in weights.items()},
        expected_weights(agent.policy_config, agent.critic_config),
        f"agent {agent.name!r} does not fit its configurations",
        "initialize its networks with policy_config and critic_config",
    )
    if agent.states is not None:
        _check_states(agent)


def _check_states(agent: Agent) -> None:
    """ValueError if the state bank does not fit the agent's sizes and robots."""
    count, total = agent.num_states, 0
    for name, (rest, dtype) in state_shapes(agent.sizes).items():
        shape = (count, *rest)
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


# ---------------------------------------------------------------------- loading


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
        before = _version(folder)
        try:
            agent = _load(folder)
            break
        except (ValueError, FileNotFoundError):
            # Files of two agents do not fit, if another process has saved one in between.
            if _version(folder) == before:
                raise
    known = folder.parent == data_dir() / "checkpoints"
    return dataclasses.replace(agent, name=folder.name) if known else agent


def load_curve(name_or_folder: str | Path) -> dict[str, np.ndarray]:
    """Columns of an agent's learning curve (`files.read_curve`).

    Raises FileNotFoundError if the agent has none.
    """
    path = current(agent_folder(name_or_folder), CURVE)
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist: this agent has no learning curve")
    return read_curve(path)


def _version(folder: Path):
    """What changes whenever an agent is saved in a folder."""
    try:
        status = current(folder, DESCRIPTION).stat()
        return status.st_ino, status.st_mtime_ns, status.st_size
    except FileNotFoundError:
        return None


def _load(folder: Path) -> Agent:
    description, restore = read_description(folder), how_to_restore(folder)
    weights = _load_weights(folder, description, restore)
    states = _load_states(folder, description, restore)
    shared = ("name", "robots", "sizes", "policy_config", "critic_config", "metadata")
    agent = Agent(
        **{name: getattr(description, name) for name in shared},
        **unflatten_dict(weights, sep="/"),
        state_robots=None if states is None else states.pop("state_robots"),
        states=None if states is None else Observation(**states),
    )
    try:
        check_agent(agent)
    except ValueError as error:
        raise ValueError(
            f"the files in {folder} do not fit together: {error}; {restore}"
        ) from error
    return agent


def _load_weights(folder: Path, description: Description, restore: str) -> dict:
    path = current(folder, WEIGHTS)
    expected = expected_weights(description.policy_config, description.critic_config)

    def check(header):
        require_arrays(header, expected, f"{path} does not fit {DESCRIPTION}", restore)

    weights = read_safetensors(path, restore, check)
    _require_hash(path, weights, description.hash, restore)
    return weights


def _load_states(folder: Path, description: Description, restore: str) -> dict | None:
    path = current(folder, STATES)
    if description.states_hash is None:
        if path.exists():
            raise ValueError(
                f"{DESCRIPTION} says that the agent has no state bank, but there is {path}: "
                f"{DESCRIPTION} was edited, or the other file is of another agent; {restore}"
            )
        return None
    states = read_npz(path, state_shapes(description.sizes), restore)
    _require_hash(path, states, description.states_hash, restore)
    return states


def _require_hash(path: Path, arrays: dict, expected: str, restore: str) -> None:
    if hash_arrays(arrays) != expected:
        raise ValueError(
            f"{path} does not match the hash in {DESCRIPTION}: it was edited or belongs to another "
            f"agent; {restore}"
        )


# ---------------------------------------------------------------------- shapes


def state_shapes(sizes: Sizes) -> dict[str, tuple]:
    """Shape of one state and type of each array of a state bank."""
    return {
        "joints": ((sizes.joints, JOINT_OBSERVATION), "float32"),
        "feet": ((sizes.feet, FOOT_OBSERVATION), "float32"),
        "general": ((GENERAL,), "float32"),
        "privileged": ((PRIVILEGED,), "float32"),
        "state_robots": ((), "int32"),
    }


@functools.lru_cache
def expected_weights(policy: PolicyConfig, critic: CriticConfig) -> dict[str, tuple]:
    """Shapes and types of the weights of these networks, by flat name."""
    networks = {"policy": Policy(policy), "critic": Critic(critic)}
    variables = {
        role: jax.eval_shape(lambda network=network: initialize(network, jax.random.key(0)))
        for role, network in networks.items()
    }
    flat = flatten_dict(variables, sep="/")
    return {name: (leaf.shape, np.dtype(np.float32)) for name, leaf in flat.items()}
