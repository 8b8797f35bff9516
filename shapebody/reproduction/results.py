"""Results that are kept in data/results with their provenance."""

import json
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path

from shapebody.arguments import (
    refuse,
    require_flag,
    require_function,
    require_kind,
    require_name,
    require_number,
    require_path,
    shown,
)
from shapebody.files import atomic_write, data_dir, locked
from shapebody.provenance import provenance
from shapebody.reproduction.scale import scale
from shapebody.stored import read_json


def result_provenance(agent=None, seconds: float | None = None, **config) -> dict:
    """Where a result comes from: settings, agent, versions, commit, machine, seconds."""

    record = {"config": config, "scale": scale(), **provenance()}
    if agent is not None:
        _require_agent(agent)
        record["agent"] = {
            "name": agent.name,
            "hash": agent.hash,
            "states_hash": agent.states_hash,
            "steps": agent.metadata.get("steps"),
        }
    if seconds is not None:
        record["seconds"] = round(require_number("seconds", seconds, 0), 1)
    return record


def result(name: str, compute: Callable[[], list[dict]], agent=None, recompute=False, **config):
    """Load data/results/<name>.json, or compute it and write it there.

    At scale `smoke` it is always computed and never written. At other scales the file's name
    gains the scale unless it is `reduced`.

    Args:
        name: of the experiment.
        compute: returns tidy records, a list of flat dictionaries.
        agent: the agent that the result depends on; a result of another agent is not loaded.
        recompute: compute anew and overwrite.
        config: settings that the result depends on; other settings mean another result.

    Returns:
        {"records": [...], "provenance": {...}}.
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
    """`result` for long computations: each part is stored as soon as it is done.

    A computation that was interrupted goes on with the first part that is missing. The file may
    hold more parts than are asked for, and other processes may add theirs meanwhile. A file of
    another agent or of other settings is not overwritten: it is renamed to <name>.old.json. So is
    one in which a part has other settings of its own; the rest of it is used.

    Args:
        name, agent, config: see `result`.
        recompute: compute these parts anew; others in the file stay.
        parts: by name, functions that return the records of one part.
        progress: print a line per part that is computed.
        settings: by name of the part, what this part alone depends on.

    Returns:
        {"records": those of `parts`, in that order, "provenance": {...}}; "seconds" there is the
        sum over these parts.

    Raises:
        ValueError: for a damaged file, unless `recompute`, which keeps it as <name>.old.json.
        OSError: if the file cannot be written; the old one stays.
    """
    path, kept = result_path(name), scale() != "smoke"
    for label, value in (("recompute", recompute), ("progress", progress)):
        require_flag(label, value)
    for part, compute in _require_parts("parts", parts).items():
        require_function(f"parts[{part!r}]", compute)
    settings = {} if settings is None else _require_parts("settings", settings)
    _require_agent(agent)
    _require_json("config", config)
    known, _ = _usable_parts(path, agent, config, settings, recompute) if kept else ({}, False)
    if recompute or parts.keys() - known.keys():
        provenance()  # reads the commit of the code that is about to run
    computed = {}
    for number, (part, compute) in enumerate(parts.items(), 1):
        if part in known and not recompute:
            continue
        began = time.perf_counter()
        records = compute()
        source = result_provenance(agent, time.perf_counter() - began, **config)
        if part in settings:
            source["settings"] = settings[part]
        computed[part] = {"records": records, "provenance": source}
        if kept:
            with locked(path):
                # Read again: another process may have added parts in the meantime.
                stored, another = _usable_parts(path, agent, config, settings, overwrite=True)
                _write_parts(path, known | stored | computed, another)
        if progress:
            seconds = source["seconds"]
            print(f"{number} of {len(parts)}: {part}, {seconds:.0f} s", flush=True)
    known |= computed
    return _joined([known[part] for part in parts])


def stored_result(path) -> dict:
    """What `result` returned when it wrote that file.

    Raises FileNotFoundError if it is missing, ValueError if it is damaged.
    """
    fix = "restore it, or delete it and compute it anew"
    parts = _read_parts(require_path("path", path), fix)
    if not parts:
        raise ValueError(f"{path} holds no parts; {fix}")
    return _joined(list(parts.values()))


def _joined(parts: list[dict]) -> dict:
    latest = parts[-1]["provenance"]
    seconds = round(sum(one["provenance"]["seconds"] for one in parts), 1)
    return {
        "records": [record for one in parts for record in one["records"]],
        "provenance": {**latest, "seconds": seconds},
    }


def _write_parts(path: Path, parts: dict, another: bool) -> None:
    """Write a result's file; if it was another result's, that is kept beside it.

    The old file is at its place until the new one takes it, and stays if the disk is full.
    """
    old = None
    if another:
        number, old = 1, path.with_suffix(".old.json")
        while old.exists():
            number += 1
            old = path.with_suffix(f".old{number}.json")
        try:
            os.link(path, old)
        except OSError:  # a file system without links
            shutil.copyfile(path, old)
    try:
        atomic_write(path, _one_record_per_line(parts))
    except BaseException:
        if old is not None:
            old.unlink(missing_ok=True)
        raise
    if old is not None:
        print(f"{path.name} was of another agent or other settings, or damaged: kept as {old.name}")


def stored_parts(name: str, agent=None, settings=None, **config) -> list[str]:
    """Names of the parts that `result_in_parts` would load for these arguments."""
    path, settings = result_path(name), {} if settings is None else settings
    _require_parts("settings", settings)
    _require_agent(agent)
    _require_json("config", config)
    if scale() == "smoke":
        return []
    return list(_usable_parts(path, agent, config, settings, False)[0])


def stored_config(name: str, agent=None) -> dict | None:
    """The settings of the stored result of that name and agent; None where there is none.

    A damaged file has none: whoever wants its records is told.
    """
    path = result_path(name)
    _require_agent(agent)
    if scale() == "smoke" or not path.exists():
        return None
    try:
        parts = _read_parts(path, "")
    except ValueError:
        return None
    config = next(iter(parts.values()))["provenance"]["config"] if parts else None
    return config if _of_agent(parts, agent, config) else None


def result_path(name: str) -> Path:
    """Where `result` keeps that experiment at the scale in force."""
    suffix = "" if scale() == "reduced" else f"_{scale()}"
    require_name("name", name)
    return data_dir() / "results" / f"{name}{suffix}.json"


def _require_agent(agent) -> None:
    """TypeError if an agent that may be None lacks what tells one from another."""
    if agent is not None and not all(hasattr(agent, name) for name in ("hash", "states_hash")):
        hint = "load it with shapebody.load_agent(...)"
        raise refuse("agent", agent, "an Agent", hint, TypeError)


def _require_parts(name: str, parts) -> dict:
    """The dictionary; TypeError if it is none, or if its keys are no texts."""
    require_kind(name, parts, dict, "by name of the part")
    for part in parts:
        require_kind(f"a key of {name}", part, str, "the name of a part")
    if name == "parts" and not parts:
        raise ValueError("parts is {}; expected at least one part")
    return parts


def _require_json(name: str, value) -> None:
    """ValueError if a value cannot be written as JSON."""
    try:
        json.dumps(value)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{name} is {shown(value)}, which JSON cannot hold ({error}); expected numbers, texts, "
            "lists and dictionaries"
        ) from error


def _usable_parts(path, agent, config, settings: dict, overwrite: bool) -> tuple[dict, bool]:
    """(the parts in a result's file that belong to this agent and these settings, whether the
    file holds anything else).

    A damaged file has none if it is to be overwritten anyway.
    """
    if not os.path.lexists(path):
        return {}, False
    try:
        known = _read_parts(path, "delete it, or call with recompute=True")
    except ValueError:
        if overwrite and path.is_file():
            return {}, True
        raise
    config = json.loads(json.dumps(config))
    if not _of_agent(known, agent, config):
        return {}, True
    fitting = {part: one for part, one in known.items() if _fits(one, settings.get(part))}
    return fitting, len(fitting) < len(known)


def _of_agent(parts: dict, agent, config) -> bool:
    """Whether all parts, at least one, are of this agent (if one is given) and these settings."""
    agent = {} if agent is None else {"hash": agent.hash, "states_hash": agent.states_hash}
    sources = [one["provenance"] for one in parts.values()]
    return bool(sources) and all(
        source["config"] == config and agent.items() <= source.get("agent", {}).items()
        for source in sources
    )


def _read_parts(path: Path, fix: str) -> dict:
    """The parts in a result's file: {name: {"records": [...], "provenance": {...}}}.

    Raises FileNotFoundError if it is missing, ValueError if it is damaged.
    """

    def require(sound: bool, what: str, value, expected: str):
        if not sound:
            raise ValueError(f"{what} is {shown(value)}, expected {expected}")

    def listed(value, kind):
        return isinstance(value, list) and all(isinstance(x, kind) for x in value)

    # Records may hold NaN, where a number does not exist.
    document = read_json(path, fix, finite=False)
    try:
        parts = document.get("parts") if isinstance(document, dict) else document
        require(isinstance(parts, dict), "'parts'", parts, "an object")
        for name, part in parts.items():
            require(isinstance(part, dict), name, part, "an object")
            require(listed(part.get("records"), dict), "records", part.get("records"), "objects")
            source = part.get("provenance")
            require(isinstance(source, dict), "provenance", source, "an object")
            for key, kind, words in (
                ("config", dict, "an object"),
                ("seconds", float, "a number"),
                ("agent", dict, "an object"),
            ):
                value = source.get(key, {} if key == "agent" else None)
                require(isinstance(value, kind), key, value, words)
            own = source.get("agent", {}).values()
            require(not any(isinstance(x, list | dict) for x in own), "agent", source, "texts")
    except ValueError as error:
        raise ValueError(f"{path} is damaged ({error}); {fix}") from error
    return parts


def _fits(part: dict, settings: dict | None) -> bool:
    """Whether a stored part has these settings of its own; None asks for none."""
    return settings is None or part["provenance"].get("settings") == json.loads(
        json.dumps(settings)
    )


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
