"""The description of an agent, `agent.json`: what it holds, how it is written, read and checked."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import ConfigDict, Field, with_config
from typing_extensions import TypedDict

from shapebody.agent.agent import Agent, flat_states, flat_weights, hash_arrays
from shapebody.arguments import shown
from shapebody.configuration import (
    FileName,
    NonNegative,
    configuration,
    expecting,
    from_json,
    integer,
)
from shapebody.design.descriptions import Sizes
from shapebody.files import current
from shapebody.networks.config import CriticConfig, PolicyConfig
from shapebody.provenance import provenance
from shapebody.stored import read_json, require_regular_file

FORMAT = 1
DESCRIPTION = "agent.json"

AtLeastOne = Field(min_length=1)
Text = Annotated[str, AtLeastOne]

_open = with_config(ConfigDict(strict=True, extra="allow"))
"""Class decorator: a dictionary whose named entries are checked, and that may hold others."""


@_open
class Settings(TypedDict, total=False):
    """A training configuration, as far as it is read without being used."""

    robots: Annotated[list[Text], AtLeastOne, expecting("a list of names")]


@_open
class Phase(TypedDict, total=False):
    """A part of a run with one configuration; see `training.run_state`."""

    from_step: integer(0, 10**15)
    config: dict[str, Any]
    robots: dict[str, str]
    """Hashes of the robots' files by name; in the first phase."""
    engine: Literal["native", "mjx"]
    """In the first phase; runs from before engines were recorded are native."""


@_open
class Training(TypedDict, total=False):
    """How an agent, or its critic, was trained."""

    config: Settings
    phases: list[Phase]
    scale: str
    engine: str
    steps: integer(0, 10**15)
    seconds: NonNegative


@_open
class Metadata(Training, total=False):
    """What is said of an agent beside what its networks need; whatever fits JSON may be added."""

    policy_evaluation: Training


@configuration
class Description:
    """The contents of agent.json.

    `configuration_hash` is that of the four fields after `name`: other settings of the same shapes
    would make other networks of the same weights.
    """

    format: Literal[FORMAT]
    name: FileName
    robots: Annotated[tuple[Text, ...], AtLeastOne]
    sizes: Sizes
    policy_config: PolicyConfig
    critic_config: CriticConfig
    configuration_hash: Text
    hash: Text
    states_hash: Text | None
    metadata: Metadata


HASHED = ("robots", "sizes", "policy_config", "critic_config")
"""Fields whose hash is `configuration_hash`."""


@configuration
class OnlyMetadata:
    """The part of agent.json that is read without its arrays."""

    metadata: Metadata


def description_text(agent: Agent) -> str:
    """The text of agent.json; versions, commit and machine are added to the metadata if missing.

    Raises:
        ValueError: if metadata cannot be written as JSON, or could not be read again.
    """
    configuration = {
        "robots": list(agent.robots),
        "sizes": dataclasses.asdict(agent.sizes),
        "policy_config": dataclasses.asdict(agent.policy_config),
        "critic_config": dataclasses.asdict(agent.critic_config),
    }
    states = flat_states(agent)
    document = {
        "format": FORMAT,
        "name": agent.name,
        **configuration,
        "configuration_hash": hash_document(configuration),
        "hash": hash_arrays(flat_weights(agent)),
        "states_hash": None if states is None else hash_arrays(states),
        "metadata": {**provenance(), **agent.metadata},
    }
    try:
        text = json.dumps(document, indent=1, default=plain, allow_nan=False) + "\n"
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"metadata of agent {agent.name!r} cannot be written as JSON ({error}); use numbers, "
            "strings, lists and dictionaries, and None instead of NaN"
        ) from error
    from_json(Description, json.loads(text), f"agent {agent.name!r}")
    return text


def read_description(folder: Path) -> Description:
    """The description of the agent in a folder.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if it is damaged, of another version, or its configuration was edited.
    """
    path, restore = current(folder, DESCRIPTION), how_to_restore(folder)
    require_regular_file(path, f"{folder} is not an agent, or was copied incompletely")
    document = _read(path, restore)
    number = document.get("format", "missing")
    if number != FORMAT:
        raise ValueError(
            f"{path} is not a valid agent description: it has format {shown(number)}, expected "
            f"{FORMAT}; use the version of shapebody that wrote it, or {restore}"
        )
    description = _checked(Description, document, path, restore)
    if hash_document({name: document[name] for name in HASHED}) != description.configuration_hash:
        raise ValueError(
            f"{', '.join(HASHED)} in {path} do not match their hash: the file was edited; {restore}"
        )
    return description


def read_metadata(folder: Path) -> dict | None:
    """Metadata of the agent in a folder without its arrays; None if there is no agent.

    Raises ValueError if its description is damaged. It may be of any format: what later ones hold
    of the metadata is likely the same.
    """
    path, restore = current(folder, DESCRIPTION), how_to_restore(folder)
    if not path.exists():
        return None
    document = _read(path, restore)
    only = {name: document[name] for name in ("metadata",) if name in document}
    _checked(OnlyMetadata, only, path, restore)
    return document["metadata"]


def _read(path: Path, restore: str) -> dict:
    try:
        document = read_json(path, restore)
        if not isinstance(document, dict):
            raise ValueError(f"it holds {shown(document)}, expected an object; {restore}")
    except ValueError as error:
        raise ValueError(f"{path} is not a valid agent description: {error}") from error
    return document


def _checked(kind, document: dict, path: Path, restore: str):
    try:
        return from_json(kind, document, DESCRIPTION)
    except ValueError as error:
        raise ValueError(f"{path} is not a valid agent description ({error}); {restore}") from error


def how_to_restore(folder: Path) -> str:
    """What to do about damaged files of an agent."""
    return f"restore the folder, for example with 'git checkout -- {folder}', or train anew"


def hash_document(document: dict) -> str:
    """SHA-256 of a JSON document, independent of the order of its keys."""
    text = json.dumps(document, sort_keys=True, default=plain)
    return hashlib.sha256(text.encode()).hexdigest()


def plain(value):
    """JSON form of what the standard encoder does not know; TypeError for what has none."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if hasattr(value, "tolist"):
        return np.asarray(value).tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} is not JSON")
