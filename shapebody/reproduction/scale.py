"""Scales, what is computed at each, and the agents to use."""

import os
from dataclasses import asdict, dataclass

from shapebody.arguments import require_choice, require_list, require_name


@dataclass(frozen=True)
class Budget:
    """What differs between scales besides the size of the networks (`TrainConfig`)."""

    starts: int
    """Start designs of a design experiment."""
    episodes: int
    """Evaluation episodes per design, where a notebook evaluates some."""
    study_episodes: int
    """Evaluation episodes per design of the stored design studies (`design_study`)."""
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
"""Budgets by scale. What differs in training besides sizes is in `scales_table`."""


def scale() -> str:
    """The scale in force: SHAPEBODY_SCALE, "smoke", "reduced" (the default) or "full"."""
    value = os.environ.get("SHAPEBODY_SCALE") or "reduced"
    return require_choice("SHAPEBODY_SCALE", value, BUDGETS)


def budget() -> Budget:
    """The budget of the scale in force."""
    return BUDGETS[scale()]


def study_setting() -> dict:
    """What `design_study` takes from the budget of the scale in force."""
    one = budget()
    return dict(
        starts=one.starts,
        episodes=one.study_episodes,
        horizon=one.horizon,
        iterations=one.search_iterations,
    )


def trained_robots(robots) -> list[str]:
    """Those of `robots` that have a shipped agent, in that order."""
    from shapebody.agent.store import agents

    robots = [require_name("a name in robots", name) for name in require_list("robots", robots)]
    known = agents()
    return [name for name in robots if agent_name(name) in known]


def agent_name(robot: str) -> str:
    """Name of the shipped agent for a robot at the scale in force: at `full`, the one trained with
    the paper's networks where there is one. `smoke` uses the reduced agent."""
    from shapebody.agent.store import agents

    full = f"{require_name('robot', robot)}_full"
    return full if scale() == "full" and full in agents() else robot


def scales_table() -> list[dict]:
    """All that differs between the scales: one record per scale, with the fields of `Budget` and
    those of `TrainConfig` that are not the same at all of them.

    Beside sizes and budgets, `reduced` and `smoke` differ from `full` in the number of epochs, the
    learning rate, the critic's λ, standardized inputs, advantages that end where the command
    changes, and the softmax temperature at the start (in `policy` and `critic`). Three settings of
    `task` differ because `full` follows the authors' earlier environment (`TaskConfig.ancestors`).
    """
    from shapebody.training.config import TrainConfig

    configs = {name: asdict(TrainConfig.at_scale(name, "unitree_go2")) for name in BUDGETS}
    first = configs["full"]
    names = [x for x in first if any(one[x] != first[x] for one in configs.values())]
    return [
        {"scale": name, **{x: configs[name][x] for x in names}, **asdict(one)}
        for name, one in BUDGETS.items()
    ]
