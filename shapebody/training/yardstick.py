"""The yardstick: what a policy is worth on the same random bodies, whatever its training was.

The curriculum coefficient c says how hard the episodes are that a run sets itself, by rules and in
a task that are settings of the run; near 1 it hardly moves. So runs are compared on 256 fixed
random bodies in the task on which designs are evaluated, with mean actions.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import numpy as np

from shapebody.arguments import (
    require_engine,
    require_integer,
    require_kind,
    require_list,
    require_number,
)
from shapebody.networks.config import PolicyConfig
from shapebody.networks.policy import mean_action_policy
from shapebody.robot.robot import Robot, require_robot
from shapebody.task import curriculum
from shapebody.task.config import TaskConfig
from shapebody.task.env import MOST_ENVIRONMENTS, Locomotion
from shapebody.task.whole_episodes import Episodes, play
from shapebody.training.update import require_variables

BODIES = 256
"""Number of bodies of the yardstick."""
CURVE_BODIES = 128
"""How many of them are measured for the learning curve: every 2 million steps, that takes about a
twentieth of the training's time."""

_SEED = 256  # of bodies and episodes; no start design and no evaluation has it


class Measured(NamedTuple):
    """One episode of each of B bodies."""

    success: np.ndarray
    """bool [B]: at least 500 control steps, at a mean velocity error of at most 0.4 m/s per axis
    (the rule "tracking" of `curriculum.is_success`)."""
    returns: np.ndarray
    """float32 [B], undiscounted."""
    tracking_error: np.ndarray
    """float32 [B], mean over time and axes of |v_xy - c_xy| in m/s, each term at most 2 m/s."""
    lengths: np.ndarray
    """int32 [B], control steps."""


def yardstick(
    config: PolicyConfig,
    policy,
    robots: Robot | list[Robot],
    coefficient: float = 1.0,
    bodies: int = BODIES,
    engine: str = "auto",
) -> Measured:
    """Play one episode of up to 1,000 control steps with each of the fixed random bodies.

    Bodies are f ~ U([-c, c]^d), the same for every policy; commands up to 1 m/s, every action one
    control step late, mean actions (`TaskConfig.evaluation`).

    Args:
        config, policy: sizes and variables of the policy, such as `agent.policy_config` and
            `agent.policy`.
        robots: a robot, or several that share the bodies evenly, in order.
        coefficient: c in [0, 1]; it scales noise and pushes, too.
        bodies: their number B; with fewer, the first ones of each robot.
        engine: "native", "mjx" or "auto".

    Raises:
        ValueError: for no robots, fewer bodies than robots, c outside [0, 1].
    """
    require_kind("config", config, PolicyConfig, "such as agent.policy_config")
    require_variables("policy", policy)
    robots = tuple(require_list("robots", [robots] if isinstance(robots, Robot) else robots))
    for robot in robots:
        require_robot(robot)
    require_number("coefficient", coefficient, 0, 1)
    require_integer("bodies", bodies, 1, MOST_ENVIRONMENTS)
    require_engine("engine", engine)
    env = _environment(robots, bodies, engine)
    designs, keys = _fixed_bodies(env)
    act, embed = mean_action_policy(config)
    episodes = Episodes(coefficient * designs, keys, coefficient, one_each=True)
    results = play(env, act, functools.partial(embed, policy), episodes)
    limit = env.config.command_limit
    success = curriculum.is_success(
        env.config, results.tracking_error, results.lengths, limit, results.returns
    )
    return Measured(np.asarray(success), results.returns, results.tracking_error, results.lengths)


def due(interval: int | None, steps: int, since: int) -> bool:
    """Whether a run of `steps` steps has to be measured, once in `interval` steps (None: never),
    if that was last possible `since` steps ago."""
    return interval is not None and steps // interval != (steps - since) // interval


def curve_columns(config: PolicyConfig, policy, robots, engine: str) -> dict[str, float]:
    """Mean success and return at c = 1 and c = 0.5, as columns of the learning curve."""
    columns = {}
    for name, coefficient in (("c1", 1.0), ("half", 0.5)):
        bodies = max(CURVE_BODIES, len(robots))
        measured = yardstick(config, policy, list(robots), coefficient, bodies, engine)
        columns |= {
            f"success_{name}": float(np.mean(measured.success)),
            f"return_{name}": float(np.mean(measured.returns)),
        }
    return columns


def _fixed_bodies(env: Locomotion):
    """Designs [B, D] of U([-1, 1]^d), padded with zeros, and a key for the episode of each."""
    designs = np.zeros((env.num_envs, env.design_dim), np.float32)
    for group in env.groups:
        dim, rng = group.space.dim, np.random.default_rng(_SEED)
        designs[group.slice, :dim] = rng.uniform(-1.0, 1.0, (group.count, dim))
    key = jax.random.PRNGKey(_SEED)
    keys = jax.vmap(functools.partial(jax.random.fold_in, key))(np.arange(env.num_envs))
    return designs, np.asarray(keys)


@functools.lru_cache(maxsize=2)
def _environment(robots: tuple[Robot, ...], bodies: int, engine: str) -> Locomotion:
    return Locomotion(list(robots), bodies, engine, TaskConfig.evaluation(), auto_reset=False)
