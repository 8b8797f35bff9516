"""Scales, agents to use at each, and experiments whose results are kept with their provenance."""

import importlib.metadata
import json
import os
import platform
import subprocess
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

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


BUDGETS = {
    "smoke": Budget(2, 2, 4, 2, 512, 0.4, 2),
    "reduced": Budget(10, 50, 256, 8, 400_000, 6.0, 12),
    "full": Budget(10, 200, 256, 32, 20_000_000, 10.0, 12),
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
    packages = ("jax", "mujoco", "flax", "optax", "numpy")
    record = {
        "config": config,
        "scale": scale(),
        "versions": {name: importlib.metadata.version(name) for name in packages},
        "commit": _commit(),
        "machine": f"{platform.machine()}, {os.cpu_count()} CPU cores",
    }
    if agent is not None:
        record["agent"] = {
            "name": agent.name,
            "hash": agent.hash,
            "steps": agent.metadata.get("steps"),
        }
    if seconds is not None:
        record["seconds"] = round(seconds, 1)
    return record


def _commit() -> str | None:
    try:
        found = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            timeout=10,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return found.stdout.strip() or None


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
            source = stored["provenance"]
            same = source["config"] == config
            same &= agent is None or source["agent"]["hash"] == agent.hash
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


def single_robot_design(
    agent,
    robot,
    starts: int = 10,
    episodes: int = 200,
    trust_regions=(20.0, 100.0),
    seed: int = 0,
    progress: bool = False,
) -> list[dict]:
    """VGDS and the penalty alone, from the paper's start designs and from the reference.

    Every found design, every start and the reference are evaluated on the same episodes.

    Returns:
        One record per design: origin ("start" or "reference"), start number, method ("none",
        "vgds", "penalty-only"), trust_region, mean return, tracking error, length, share of
        episodes that became non-finite, predicted value (mean critic value without penalty), and
        the search's seconds per design.
    """
    from shapebody.design import DesignSpace
    from shapebody.evaluation import evaluate
    from shapebody.search import Objective, search

    space = DesignSpace(robot)
    initial = np.stack([space.start(i) for i in range(starts)])
    designs, records = [], []

    def add(found, origin, method, trust_region=None, seconds=0.0):
        for i, f in enumerate(np.atleast_2d(found)):
            designs.append(f)
            records.append(
                {
                    "origin": origin,
                    "start": i if origin == "start" else None,
                    "method": method,
                    "trust_region": trust_region,
                    "search_seconds": seconds / len(np.atleast_2d(found)),
                }
            )

    add(initial, "start", "none")
    add(space.reference, "reference", "none")
    for trust_region in trust_regions:
        for method in ("vgds", "penalty-only"):
            found = search(method, agent, robot, initial, trust_region=trust_region, seed=seed)
            add(found.design, "start", method, trust_region, found.seconds)
        found = search("vgds", agent, robot, space.reference, trust_region=trust_region, seed=seed)
        add(found.design, "reference", "vgds", trust_region, found.seconds)
    designs = np.stack(designs)
    predicted = Objective.of(agent, robot, 0.0).value(designs)
    score = evaluate(agent, robot, designs, episodes=episodes, seed=seed, progress=progress)
    for i, record in enumerate(records):
        record |= {
            "return": float(score.returns[i].mean()),
            "return_std": float(score.returns[i].std(ddof=1)) if episodes > 1 else 0.0,
            "tracking_error": float(score.tracking_error[i].mean()),
            "length": float(score.lengths[i].mean()),
            "predicted_value": float(predicted[i]),
            "episodes": episodes,
        }
    return records


def value_against_return(
    agent, robot, designs: int = 256, episodes: int = 8, seed: int = 1000, progress: bool = False
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
    score = evaluate(agent, robot, f, episodes=episodes, seed=seed, progress=progress)
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
