"""Scales, agents to use at each, and experiments whose results are kept with their provenance."""

import json
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np

from shapebody.paths import data_dir


@dataclass(frozen=True)
class Budget:
    """What differs between scales besides the size of the networks (`TrainConfig`)."""

    starts: int
    """Start designs of a design experiment."""
    episodes: int
    """Evaluation episodes per design."""
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
    "smoke": Budget(2, 2, 4, 2, 512, 0.4, 2, 100),
    "reduced": Budget(10, 50, 256, 8, 400_000, 6.0, 12, 1000),
    "full": Budget(10, 200, 256, 32, 20_000_000, 10.0, 12, 1000),
}
"""The table of scales. The method is the same at all of them."""


def scale() -> str:
    """The scale in force: SHAPEBODY_SCALE, "smoke", "reduced" (the default) or "full"."""
    value = os.environ.get("SHAPEBODY_SCALE") or "reduced"
    if value not in BUDGETS:
        raise ValueError(f"SHAPEBODY_SCALE is {value!r}; expected one of {', '.join(BUDGETS)}")
    return value


def budget() -> Budget:
    """The budget of the scale in force."""
    return BUDGETS[scale()]


def agent_name(robot: str) -> str:
    """Name of the shipped agent for a robot at the scale in force: at `full`, the one trained with
    the paper's networks where there is one. `smoke` uses the reduced agent."""
    full = f"{robot}_full"
    if scale() == "full" and (data_dir() / "checkpoints" / full).is_dir():
        return full
    return robot


def provenance(agent=None, seconds: float | None = None, **config) -> dict:
    """Where a result comes from: settings, agent, versions, commit, machine, seconds."""
    from shapebody import checkpoints

    record = {"config": config, "scale": scale(), **checkpoints.provenance()}
    if agent is not None:
        record["agent"] = {
            "name": agent.name,
            "hash": agent.hash,
            "states_hash": agent.states_hash,
            "steps": agent.metadata.get("steps"),
        }
    if seconds is not None:
        record["seconds"] = round(seconds, 1)
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
    suffix = "" if scale() == "reduced" else f"_{scale()}"
    path = data_dir() / "results" / f"{name}{suffix}.json"
    config = json.loads(json.dumps(config))
    if path.exists() and not recompute and scale() != "smoke":
        try:
            stored = json.loads(path.read_text())
            source, _ = stored["provenance"], stored["records"]
            same = source["config"] == config
            if agent is not None:
                known = source["agent"]
                same &= known["hash"] == agent.hash
                same &= known.get("states_hash", agent.states_hash) == agent.states_hash
        except (json.JSONDecodeError, KeyError, TypeError) as error:
            raise ValueError(
                f"{path.name} in data/results is damaged ({error}); delete it, or call with "
                "recompute=True"
            ) from error
        if same:
            return stored
    began = time.perf_counter()
    records = compute()
    seconds = time.perf_counter() - began
    stored = {"records": records, "provenance": provenance(agent, seconds, **config)}
    if scale() != "smoke":
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(path.name + ".tmp")
        temporary.write_text(json.dumps(stored, indent=1) + "\n")
        os.replace(temporary, path)
    return stored


# ------------------------------------------------------------------ single-robot design (4.1)


def single_robot_design(agent, robot, trust_regions=(20.0, 100.0), **settings) -> list[dict]:
    """VGDS and the penalty alone from the paper's start designs, and VGDS from the reference.

    Args:
        agent, robot: who is asked, and about which robot.
        trust_regions: λ of VGDS.
        settings: see `design_study`, whose records are returned.
    """
    runs = [("start", "penalty-only", None)]
    for trust_region in trust_regions:
        runs += [("start", "vgds", trust_region), ("reference", "vgds", trust_region)]
    return design_study(agent, robot, runs, **settings)


def design_study(
    agent,
    robot,
    runs,
    starts: int = 10,
    episodes: int = 200,
    horizon: int = 1000,
    seed: int = 0,
    progress: bool = False,
) -> list[dict]:
    """Search for designs in several ways and let the frozen policy walk with all of them.

    Every found design, every start and the reference are evaluated on the same episodes of
    `horizon` control steps.

    Args:
        agent, robot: who is asked, and about which robot.
        runs: searches (origin, method, λ). origin "start": from the paper's start designs, all in
            one batch; "reference": from f = 0. The penalty alone has no λ (None), because Adam
            removes the scale of its gradient.
        starts: number of start designs.
        episodes: evaluation episodes per design.
        seed: of the searches and of the evaluation.
        progress: show the evaluation's progress.

    Returns:
        One record per design: origin, start number, method ("none" for the designs where searches
        begin), trust_region, the search's seconds per design (without compilation), critic
        evaluations per design, mean return, its deviation over episodes, the gain over the design
        where the search began with its 95 % interval over paired episodes, tracking error (m/s),
        length (control steps), number of episodes that became non-finite, predicted value (mean
        critic value over the state bank, without penalty) and distance |f - f_ref| / sqrt(d).
    """
    from shapebody.design import DesignSpace
    from shapebody.evaluation import evaluate, paired_gain
    from shapebody.search import Objective, search

    space = DesignSpace(robot)
    initial = {
        "start": np.stack([space.start(i) for i in range(starts)]),
        "reference": space.reference[None],
    }
    designs, records = [], []

    def add(origin, method, trust_region, found, seconds=0.0, evaluations=0):
        for i, f in enumerate(found):
            designs.append(f)
            records.append(
                {
                    "origin": origin,
                    "start": i if origin == "start" else None,
                    "method": method,
                    "trust_region": trust_region,
                    "search_seconds": seconds / len(found),
                    "evaluations": evaluations,
                }
            )

    for origin, f in initial.items():
        add(origin, "none", None, f)
    for origin, method, trust_region in runs:
        given = 100.0 if trust_region is None else trust_region
        found = search(method, agent, robot, initial[origin], trust_region=given, seed=seed)
        seconds = found.seconds - found.compile_seconds
        add(origin, method, trust_region, found.design, seconds, found.evaluations)
    designs = np.stack(designs)
    predicted = Objective.of(agent, robot, 0.0).value(designs)
    config = _evaluation(episodes, horizon)
    score = evaluate(agent, robot, designs, seed=seed, config=config, progress=progress)
    for i, record in enumerate(records):
        began = starts if record["origin"] == "reference" else record["start"]
        gain = paired_gain(score.returns[i], score.returns[began])
        record |= {
            "return": float(score.returns[i].mean()),
            "return_std": float(score.returns[i].std(ddof=1)) if episodes > 1 else 0.0,
            "gain": gain.mean,
            "gain_low": gain.low,
            "gain_high": gain.high,
            "non_finite": int(score.non_finite[i]),
            "tracking_error": float(score.tracking_error[i].mean()),
            "length": float(score.lengths[i].mean()),
            "predicted_value": float(predicted[i]),
            "distance": float(np.sqrt(np.mean(designs[i] ** 2))),
            "episodes": episodes,
            "engine": score.settings["engine"],
        }
    return records


def _evaluation(episodes: int, horizon: int):
    from shapebody.evaluation import EvaluationConfig
    from shapebody.locomotion import TaskConfig

    return EvaluationConfig(episodes=episodes, task=TaskConfig.evaluation(horizon=horizon))


def gains(records: list[dict]) -> list[dict]:
    """Gains in return ΔR with 95 % intervals, from the records of `design_study`.

    Returns:
        One record per comparison: method, over ("start", "penalty-only" or "reference"),
        trust_region (None where none was used), mean, low and high of the paired difference in
        return, the number of pairs, and how many of them are positive. The pairs are the starts;
        for the search from the reference they are the episodes of one pair of designs.

    Raises:
        ValueError: if a design has no counterpart to be compared with.
    """
    from shapebody.evaluation import paired_gain

    found: dict = {}
    for record in records:
        if record["origin"] == "start":
            key = record["method"], record["trust_region"]
            found.setdefault(key, {})[record["start"]] = record["return"]
    reference = [r for r in records if r["origin"] == "reference"]
    base = [r["return"] for r in reference if r["method"] == "none"]
    initial = found.get(("none", None), {})
    if len(base) != 1 or not initial:
        raise ValueError(
            f"the records hold {len(base)} evaluations of the reference and {len(initial)} of "
            "starts; expected one and at least one, as design_study returns them"
        )
    rows = []

    def compare(method, over, trust_region, after, before):
        if after.keys() != before.keys():
            raise ValueError(
                f"{method} at lambda {trust_region} has starts {sorted(after)}, {over} has "
                f"{sorted(before)}; both need the same, compute the records anew"
            )
        order = sorted(after)
        gain = paired_gain([after[i] for i in order], [before[i] for i in order])
        row(method, over, trust_region, *gain[:3], len(order), int(np.sum(gain.differences > 0)))

    def row(method, over, trust_region, mean, low, high, pairs, positive):
        values = dict(mean=mean, low=low, high=high, pairs=pairs, positive=positive)
        rows.append({"method": method, "over": over, "trust_region": trust_region, **values})

    compare("reference", "start", None, dict.fromkeys(initial, base[0]), initial)
    for (method, trust_region), after in found.items():
        if method == "none":
            continue
        compare(method, "start", trust_region, after, initial)
        if method != "penalty-only":
            control = found.get(("penalty-only", None))
            if control is not None:
                compare(method, "penalty-only", trust_region, after, control)
    for r in reference:
        if r["method"] != "none":
            interval = r["gain"], r["gain_low"], r["gain_high"]
            row(r["method"], "reference", r["trust_region"], *interval, r["episodes"], None)
    return rows


def gain(rows: list[dict], method: str, over: str, trust_region: float | None = None) -> dict:
    """The one row of `gains` with that method, comparison and λ; ValueError if there is none."""
    wanted = {"method": method, "over": over, "trust_region": trust_region}
    for row in rows:
        if all(row[name] == value for name, value in wanted.items()):
            return row
    known = ", ".join(f"{r['method']} over {r['over']} at {r['trust_region']}" for r in rows)
    raise ValueError(f"there is no gain of {method} over {over} at {trust_region}; known: {known}")


def verdict(low: float, high: float) -> str:
    """What an interval of a difference allows to say about its sign."""
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

    x, y = np.asarray(x, float), np.asarray(y, float)
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


def value_against_return(
    agent,
    robot,
    designs: int = 256,
    episodes: int = 8,
    horizon: int = 1000,
    seed: int = 1000,
    progress: bool = False,
) -> list[dict]:
    """Predicted value and true return of random designs of the full design space.

    Returns:
        One record per design: its number, predicted value and mean return.
    """
    from shapebody.design import DesignSpace
    from shapebody.evaluation import evaluate
    from shapebody.search import Objective

    space = DesignSpace(robot)
    f = np.stack([space.start(seed + i) for i in range(designs)])
    predicted = np.asarray(Objective.of(agent, robot, 0.0).value(f))
    config = _evaluation(episodes, horizon)
    score = evaluate(agent, robot, f, seed=seed, config=config, progress=progress)
    return [
        {
            "design": seed + i,
            "predicted_value": float(predicted[i]),
            "return": float(score.returns[i].mean()),
        }
        for i in range(designs)
    ]


def scales_table() -> list[dict]:
    """All that differs between the scales, one record per scale."""
    from shapebody.ppo import TrainConfig

    rows = []
    for name, one in BUDGETS.items():
        config = TrainConfig.at_scale(name, "unitree_go2")
        rows.append(
            {
                "scale": name,
                "environments": config.num_envs,
                "rollout": config.rollout_length,
                "minibatch": config.minibatch_size,
                "epochs": config.epochs,
                "training steps": config.total_steps,
                "learning rate": config.learning_rate,
                "policy": asdict(config.policy),
                "critic": asdict(config.critic),
                **asdict(one),
            }
        )
    return rows


def derived_constants(
    agent, robot, starts: int = 10, episodes: int = 16, seed: int = 0
) -> list[dict]:
    """How much returns depend on MuJoCo's derived constants (`body_invweight0` and the like).

    The paper's environment leaves them at the reference when a body changes, and so do we; the
    native engine can recompute them for every design.

    Returns:
        One record per design (the reference, then the starts): mean return with the reference's
        constants, with recomputed ones, and the standard error of their paired difference.
    """
    from shapebody.design import DesignSpace
    from shapebody.evaluation import EvaluationConfig, evaluate

    space = DesignSpace(robot)
    designs = np.stack([space.reference] + [space.start(i) for i in range(starts)])
    kept, recomputed = (
        evaluate(
            agent,
            robot,
            designs,
            episodes=episodes,
            seed=seed,
            engine="native",
            config=EvaluationConfig(recompute_constants=value),
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
    """Save a picture of a start design, the design VGDS finds from it, and the reference."""
    from shapebody import video
    from shapebody.design import DesignSpace
    from shapebody.search import search

    space = DesignSpace(robot)
    f = space.start(start)
    found = search("vgds", agent, robot, f, trust_region=trust_region).design
    models = [space.to_model(x) for x in (f, found, space.reference)]
    labels = [f"start design {start}", "found by VGDS", "reference"]
    picture = video.body_grid(models, labels=labels, columns=3)
    from PIL import Image

    Image.fromarray(picture).save(path)
