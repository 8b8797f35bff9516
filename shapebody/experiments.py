"""Scales, agents to use at each, and experiments whose results are kept with their provenance."""

import io
import json
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from shapebody.checks import (
    refuse,
    require_array,
    require_choice,
    require_flag,
    require_function,
    require_integer,
    require_kind,
    require_list,
    require_name,
    require_number,
    require_output,
    require_path,
    require_seed,
    shown,
)
from shapebody.files import atomic_write, locked
from shapebody.paths import data_dir
from shapebody.stored import read_json


@dataclass(frozen=True)
class Budget:
    """What differs between scales besides the size of the networks (`TrainConfig`)."""

    starts: int
    """Start designs of a design experiment."""
    episodes: int
    """Evaluation episodes per design, where a notebook evaluates some."""
    study_episodes: int
    """Evaluation episodes per design of the stored design studies (`studies`)."""
    search_iterations: int | None
    """Iterations of their searches; None for the paper's."""
    random_designs: int
    """Designs over which value and return are compared."""
    random_episodes: int
    """Evaluation episodes for each of them."""
    live_steps: int
    """Environment steps of a training run inside a notebook."""
    video_seconds: float
    """Length of a video."""
    grid: int
    """Bodies in a picture of random designs."""
    horizon: int
    """Control steps of an evaluation episode."""


BUDGETS = {
    "smoke": Budget(2, 2, 2, 2, 4, 2, 512, 0.4, 2, 100),
    "reduced": Budget(10, 50, 50, None, 256, 8, 400_000, 6.0, 12, 1000),
    "full": Budget(10, 200, 200, None, 256, 32, 20_000_000, 10.0, 12, 1000),
}
"""Budgets by scale. What training changes beside sizes is in `scales_table`."""


def scale() -> str:
    """The scale in force: SHAPEBODY_SCALE, "smoke", "reduced" (the default) or "full"."""
    value = os.environ.get("SHAPEBODY_SCALE") or "reduced"
    return require_choice("SHAPEBODY_SCALE", value, BUDGETS)


def budget() -> Budget:
    """The budget of the scale in force."""
    return BUDGETS[scale()]


def study_setting() -> dict:
    """What `studies.design_study` takes from the budget of the scale in force."""
    one = budget()
    return dict(
        starts=one.starts,
        episodes=one.study_episodes,
        horizon=one.horizon,
        iterations=one.search_iterations,
    )


def trained_robots(robots) -> list[str]:
    """Those of `robots` that have a shipped agent, in that order."""
    from shapebody.checkpoints import agents

    robots = [require_name("a name in robots", name) for name in require_list("robots", robots)]
    known = agents()
    return [name for name in robots if agent_name(name) in known]


def agent_name(robot: str) -> str:
    """Name of the shipped agent for a robot at the scale in force: at `full`, the one trained with
    the paper's networks where there is one. `smoke` uses the reduced agent."""
    from shapebody.checkpoints import agents

    full = f"{require_name('robot', robot)}_full"
    return full if scale() == "full" and full in agents() else robot


def provenance(agent=None, seconds: float | None = None, **config) -> dict:
    """Where a result comes from: settings, agent, versions, commit, machine, seconds."""
    from shapebody import checkpoints

    record = {"config": config, "scale": scale(), **checkpoints.provenance()}
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
        source = provenance(agent, time.perf_counter() - began, **config)
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


# ------------------------------------------------------------------ statistics


def verdict(low: float, high: float) -> str:
    """What an interval of a difference allows to say about its sign."""
    if require_number("low", low) > require_number("high", high):
        raise ValueError(f"low is {low} and high is {high}; expected low <= high")
    if low > 0:
        return "positive: the whole interval is above zero"
    if high < 0:
        return "negative: the whole interval is below zero"
    return "not settled: the interval contains zero"


def rank_correlation(x, y, resamples: int = 2000, seed: int = 0) -> tuple[float, float, float]:
    """Spearman's ρ of x and y [n] and its 95 % bootstrap interval over pairs: (ρ, low, high).

    NaN where ρ does not exist because x or y is constant. Raises ValueError below three pairs.
    """
    from scipy.stats import rankdata

    x, y = require_array("x", x).astype(float), require_array("y", y).astype(float)
    require_integer("resamples", resamples, 1, 1_000_000)
    require_seed("seed", seed)
    if x.shape != y.shape or x.ndim != 1 or len(x) < 3:
        raise ValueError(f"x {x.shape} and y {y.shape}: expected two lists of three or more pairs")

    def correlation(x, y):
        a, b = (rankdata(v, axis=-1) for v in (x, y))
        a, b = (v - v.mean(-1, keepdims=True) for v in (a, b))
        scale = np.sqrt((a * a).sum(-1) * (b * b).sum(-1))
        return np.where(scale > 0, (a * b).sum(-1) / np.where(scale > 0, scale, 1.0), np.nan)

    chosen = np.random.default_rng(seed).integers(0, len(x), (resamples, len(x)))
    samples = correlation(x[chosen], y[chosen])
    samples = samples[np.isfinite(samples)]
    low, high = np.quantile(samples, [0.025, 0.975]) if len(samples) else (np.nan, np.nan)
    return float(correlation(x, y)), float(low), float(high)


def scales_table() -> list[dict]:
    """All that differs between the scales: one record per scale, with the fields of `Budget` and
    those of `TrainConfig` that are not the same at all of them.

    Beside sizes and budgets, `reduced` and `smoke` differ from `full` in the number of epochs, the
    learning rate, the critic's λ, standardized inputs, advantages that end where the command
    changes, and the softmax temperature at the start (in `policy` and `critic`). Three settings of
    `task` differ because `full` follows the authors' earlier environment (`TaskConfig.ancestors`).
    """
    from shapebody.ppo import TrainConfig

    configs = {name: asdict(TrainConfig.at_scale(name, "unitree_go2")) for name in BUDGETS}
    first = configs["full"]
    names = [x for x in first if any(one[x] != first[x] for one in configs.values())]
    return [
        {"scale": name, **{x: configs[name][x] for x in names}, **asdict(one)}
        for name, one in BUDGETS.items()
    ]


def derived_constants(
    agent, robot, starts: int = 10, episodes: int = 16, seed: int = 0, horizon: int = 1000
) -> list[dict]:
    """How much returns depend on MuJoCo's derived constants (`body_invweight0` and the like).

    data/results/derived_constants_go2.json is `result("derived_constants_go2", ...)` of this.

    The paper's environment leaves them at the reference when a body changes, and so do we; the
    native engine can recompute them for every design.

    Returns:
        One record per design (the reference, then the starts): mean return with the reference's
        constants, with recomputed ones, and the standard error of their paired difference.
    """
    from shapebody.design import DesignSpace
    from shapebody.evaluation import EvaluationConfig, evaluate
    from shapebody.locomotion import TaskConfig

    space = DesignSpace(robot)
    require_integer("starts", starts, 0, 100_000)
    # A standard error needs two.
    require_integer("episodes", episodes, 2, 1_000_000)
    designs = np.stack([space.reference] + [space.start(i) for i in range(starts)])
    kept, recomputed = (
        evaluate(
            agent,
            robot,
            designs,
            episodes=episodes,
            seed=seed,
            engine="native",
            config=EvaluationConfig(
                recompute_constants=value, task=TaskConfig.evaluation(horizon=horizon)
            ),
        ).returns
        for value in (False, True)
    )
    difference = recomputed - kept
    return [
        {
            "design": "reference" if i == 0 else f"start {i - 1}",
            "return": float(kept[i].mean()),
            "return_recomputed": float(recomputed[i].mean()),
            "standard_error": float(difference[i].std(ddof=1) / np.sqrt(episodes)),
        }
        for i in range(len(designs))
    ]


def before_after(agent, robot, path, start: int = 3, trust_region: float = 100.0) -> None:
    """Save a picture of a start design, the design VGDS finds from it, and the reference.

    The PNG's text entry "provenance" says of which agent.
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    from shapebody import video
    from shapebody.design import DesignSpace
    from shapebody.search import search

    path = require_output("path", path)
    space = DesignSpace(robot)
    f = space.start(start)
    found = search("vgds", agent, robot, f, trust_region=trust_region).design
    models = [space.to_model(x) for x in (f, found, space.reference)]
    labels = [f"start design {start}", "found by VGDS", "reference"]
    picture = video.body_grid(models, labels=labels, columns=3)
    source = PngInfo()
    source.add_text(
        "provenance", json.dumps(provenance(agent, start=start, trust_region=trust_region))
    )
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="PNG", pnginfo=source)
    atomic_write(path, buffer.getvalue())
