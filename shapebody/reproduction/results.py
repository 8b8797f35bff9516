"""Results that are kept in data/results, each with its provenance.

The file of a result belongs to one agent and to one choice of settings. It holds parts, each with
its records; `result` makes files of one part. Parts are written as soon as they are computed, one
file at a time and whole: a computation that was interrupted goes on with what is missing, and
several processes may compute different parts.
"""

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import NotRequired

import pandas as pd
import pydantic
from typing_extensions import TypedDict

from shapebody.agent.agent import require_agent
from shapebody.arguments import (
    require_flag,
    require_function,
    require_kind,
    require_name,
    require_number,
    require_path,
    require_records,
    shown,
)
from shapebody.files import atomic_write, data_dir, locked
from shapebody.provenance import provenance
from shapebody.reproduction.scale import scale
from shapebody.stored import read_json

# ------------------------------------------------------------------ computing and loading


def result(name: str, compute: Callable[[], list[dict]], agent=None, recompute=False, **config):
    """Load data/results/<name>.json, or compute it and write it there.

    At scale `smoke` it is always computed and never written. At other scales the file's name
    gains the scale unless it is `reduced`.

    Args:
        name: of the experiment.
        compute: returns tidy records, a list of flat dictionaries.
        agent: the agent that the result depends on.
        recompute: compute again, and overwrite what is stored.
        config: settings that the result depends on.

    Returns:
        {"records": [...], "provenance": {...}}; `frame` makes a table of it.

    Raises:
        ValueError: if the file is damaged, or belongs to another agent or to other settings; not
            with `recompute`.
        OSError: if the file cannot be written; the old one stays.
    """
    require_function("compute", compute)
    return result_in_parts(name, {"all": compute}, agent, recompute, **config)


def result_in_parts(
    name: str,
    parts: dict[str, Callable[[], list[dict]]],
    agent=None,
    recompute: bool = False,
    progress: bool = False,
    settings: dict[str, dict] | None = None,
    **config,
):
    """`result` for long computations: each part is stored as soon as it is computed.

    The file may hold more parts than are asked for, and other processes may add theirs meanwhile.

    Args:
        name, agent, config: see `result`.
        parts: by name, functions that return the records of one part.
        recompute: compute these parts again. Others stay, unless the file is another agent's or has
            other settings: it is then replaced.
        progress: print a line per part that is computed.
        settings: by name of the part, what this part alone depends on.

    Returns:
        {"records": those of `parts`, in that order, "provenance": {...}}; "seconds" there is the
        sum over these parts.

    Raises:
        ValueError, OSError: see `result`.
    """
    for part, compute in _require_parts("parts", parts).items():
        require_function(f"parts[{part!r}]", compute)
    require_flag("recompute", recompute)
    require_flag("progress", progress)
    settings = {} if settings is None else _require_parts("settings", settings)
    file = _File(name, agent, config)

    # What is stored already.
    known = {} if recompute else file.read()
    for part in parts.keys() & known.keys():
        if other := _other_settings(known[part], settings.get(part)):
            raise ValueError(f"{part!r} in {file.path} has other settings: {other}; {FIX}")
    missing = [part for part in parts if part not in known]
    if missing:
        provenance()  # reads the commit of the code that is about to run

    # What is not, part by part.
    for number, part in enumerate(missing, 1):
        began = time.perf_counter()
        records = parts[part]()
        source = result_provenance(agent, time.perf_counter() - began, **config)
        if part in settings:
            source["settings"] = settings[part]
        known[part] = {"records": records, "provenance": source}
        file.add(part, known[part], replace=recompute)
        if progress:
            seconds = source["seconds"]
            print(f"{number} of {len(missing)}: {part}, {seconds:.0f} s", flush=True)
    return _joined([known[part] for part in parts])


def frame(records) -> pd.DataFrame:
    """The records of a result as a table with a row per record.

    None is NaN in a column of numbers, such as the λ of penalty only.

    Args:
        records: a list of records, or what `result`, `design_study` and the like return.
    """
    if isinstance(records, pd.DataFrame):
        return records
    if isinstance(records, dict) and "records" in records:
        records = records["records"]
    return pd.DataFrame(require_records("records", records, ()))


# ------------------------------------------------------------------ looking at what is stored


def stored_result(path) -> dict:
    """What `result` returned when it wrote that file.

    Raises:
        FileNotFoundError: if the file does not exist.
        ValueError: if it is damaged.
    """
    fix = "restore it, or delete it and compute it again"
    parts = _read(require_path("path", path), fix)
    if not parts:
        raise ValueError(f"{path} holds no parts; {fix}")
    return _joined(list(parts.values()))


def stored_parts(name: str, agent=None, settings=None, **config) -> list[str]:
    """Names of the parts that `result_in_parts` would load for these arguments."""
    settings = {} if settings is None else _require_parts("settings", settings)
    file = _File(name, agent, config)
    if not file.kept or not os.path.lexists(file.path):
        return []
    parts = _read(file.path, FIX)
    if file.other(parts, file.config):
        return []
    return [part for part in parts if not _other_settings(parts[part], settings.get(part))]


def stored_config(name: str, agent=None) -> dict | None:
    """The settings of the stored result of that name and agent; None where there is none.

    A damaged file has none: `result` says what is wrong with it.
    """
    file = _File(name, agent, {})
    if not file.kept:
        return None
    try:
        parts = _read(file.path, FIX)
    except (FileNotFoundError, ValueError):
        return None
    config = next(iter(parts.values()))["provenance"]["config"] if parts else None
    return None if file.other(parts, config) else config


def result_path(name: str) -> Path:
    """Where `result` keeps that experiment at the scale in force."""
    suffix = "" if scale() == "reduced" else f"_{scale()}"
    require_name("name", name)
    return data_dir() / "results" / f"{name}{suffix}.json"


def result_provenance(agent=None, seconds: float | None = None, **config) -> dict:
    """Where a result comes from: settings, scale, agent, versions, commit, machine, seconds."""
    record = {"config": config, "scale": scale(), **provenance()}
    if identity := _identity(agent):
        steps = agent.metadata.get("steps")
        record["agent"] = {"name": agent.name, **identity, "steps": steps}
    if seconds is not None:
        record["seconds"] = round(require_number("seconds", seconds, 0), 1)
    return record


def _identity(agent) -> dict:
    """What tells an agent from others; nothing for None. TypeError if it is not an `Agent`."""
    if agent is None:
        return {}
    require_agent(agent)
    return {"hash": agent.hash, "states_hash": agent.states_hash}


def _joined(parts: list[dict]) -> dict:
    latest = parts[-1]["provenance"]
    seconds = round(sum(one["provenance"]["seconds"] for one in parts), 1)
    return {
        "records": [record for one in parts for record in one["records"]],
        "provenance": {**latest, "seconds": seconds},
    }


# ------------------------------------------------------------------ files

FIX = "delete it, or call with recompute=True, which overwrites it"


class _File:
    """The file of a result at the scale in force, for one agent and one choice of settings."""

    def __init__(self, name: str, agent, config: dict):
        self.path, self.kept = result_path(name), scale() != "smoke"
        self.agent, self.config = _identity(agent), _as_json("config", config)

    def read(self, replace: bool = False) -> dict[str, dict]:
        """The stored parts; ValueError if they are damaged or belong to another result.

        With `replace`, such a file counts as empty, because it will be overwritten.
        """
        if not self.kept or not os.path.lexists(self.path):
            return {}
        try:
            parts = _read(self.path, FIX)
            if other := self.other(parts, self.config):
                raise ValueError(f"{self.path} is of another result: {other}; {FIX}")
        except ValueError:
            if replace and self.path.is_file():
                return {}
            raise
        return parts

    def other(self, parts: dict, config: dict) -> str:
        """How the agent or the settings of stored parts differ; "" if they are the same."""
        for part in parts.values():
            source = part["provenance"]
            agent = {key: source.get("agent", {}).get(key) for key in self.agent}
            if difference := _difference(agent, self.agent):
                return f"its agent's {difference}"
            if difference := _difference(source["config"], config):
                return difference
        return ""

    def add(self, name: str, part: dict, replace: bool) -> None:
        """Write a part into the file, beside those that other processes may have added."""
        if self.kept:
            with locked(self.path):
                parts = self.read(replace) | {name: part}
                atomic_write(self.path, _one_record_per_line(parts))


def _difference(there: dict, here: dict) -> str:
    """The entries in which two dictionaries differ; "" if they do not."""
    keys = [key for key in here | there if there.get(key) != here.get(key)]
    return ", ".join(
        f"{key} is {shown(there.get(key))} there and {shown(here.get(key))} here" for key in keys
    )


def _other_settings(part: dict, settings: dict | None) -> str:
    """How a stored part's own settings differ from these; "" if they do not, or none are given."""
    if settings is None:
        return ""
    return _difference(part["provenance"].get("settings") or {}, _as_json("settings", settings))


class _Source(TypedDict):
    """What the provenance of a part has to say; it says more."""

    __pydantic_config__ = pydantic.ConfigDict(extra="allow", strict=True)
    config: dict
    seconds: float
    agent: NotRequired[dict]
    settings: NotRequired[dict]


class _Part(TypedDict):
    __pydantic_config__ = pydantic.ConfigDict(extra="allow", strict=True)
    records: list[dict]
    provenance: _Source


class _Document(TypedDict):
    __pydantic_config__ = pydantic.ConfigDict(extra="allow", strict=True)
    parts: dict[str, _Part]


_DOCUMENT = pydantic.TypeAdapter(_Document)


def _read(path: Path, fix: str) -> dict[str, dict]:
    """The parts in a result's file: {name: {"records": [...], "provenance": {...}}}.

    Raises FileNotFoundError if it does not exist, ValueError if it is damaged.
    """
    # Records may hold NaN, where a number does not exist.
    document = read_json(path, fix, finite=False)
    try:
        return _DOCUMENT.validate_python(document)["parts"]
    except pydantic.ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"])) or "the document"
        raise ValueError(f"{path} is damaged ({place}: {first['msg']}); {fix}") from error


def _one_record_per_line(parts: dict) -> str:
    """JSON of a result, short enough to read and to compare line by line."""
    texts = []
    for name, part in parts.items():
        source = json.dumps(part["provenance"])
        records = ",\n".join(f"   {json.dumps(record)}" for record in part["records"])
        texts.append(
            f' {json.dumps(name)}: {{\n  "provenance": {source},\n  "records": [\n{records}\n  ]}}'
        )
    return '{"parts": {\n' + ",\n".join(texts) + "\n}}\n"


def _require_parts(name: str, parts) -> dict:
    """The dictionary; TypeError unless it is one whose keys are names of parts."""
    require_kind(name, parts, dict, "by name of the part")
    for part in parts:
        require_kind(f"a key of {name}", part, str, "the name of a part")
    if name == "parts" and not parts:
        raise ValueError("parts is {}; expected at least one part")
    return parts


def _as_json(name: str, value):
    """The value as it comes back from JSON; ValueError if JSON cannot hold it."""
    try:
        return json.loads(json.dumps(value))
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{name} is {shown(value)}, which JSON cannot hold ({error}); expected numbers, texts, "
            "lists and dictionaries"
        ) from error
