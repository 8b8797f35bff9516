"""Returns of designs: rollouts of the frozen policy, the same episodes with every design."""

from __future__ import annotations

import dataclasses
import functools
import time
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from shapebody.agent.agent import Agent, require_agent
from shapebody.arguments import (
    require_engine,
    require_flag,
    require_kind,
    require_seed,
)
from shapebody.configuration import configuration, integer, number
from shapebody.design.space import DesignSpace
from shapebody.evaluation.statistics import (
    CONFIDENCE,
    MOST_EPISODES,
    bootstrap_interval,
    float_or_array,
)
from shapebody.networks.policy import mean_action_policy
from shapebody.robot.robot import Robot
from shapebody.task.config import TaskConfig
from shapebody.task.env import Locomotion
from shapebody.task.whole_episodes import EpisodeResults, Episodes, play

EpisodeCount = integer(1, MOST_EPISODES)
Coefficient = number("a number from 0 to 1", ge=0, le=1)


@configuration
class EvaluationConfig:
    """How designs are evaluated: 200 episodes as in the paper, with `TaskConfig.evaluation`."""

    episodes: EpisodeCount = 200
    """Episodes per design."""
    coefficient: Coefficient = 1.0
    """Curriculum coefficient c of all episodes, in [0, 1]."""
    task: TaskConfig = field(default_factory=TaskConfig.evaluation)
    """Settings of the task."""
    num_envs: EpisodeCount = 512
    """Largest number of episodes that run side by side."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Episodes of the frozen policy on one design ([E]) or on S designs ([S, E]).

    Column i of every design is the same episode: same commands, initial state, noise and pushes.
    """

    returns: np.ndarray
    """float32, undiscounted sum of rewards until the episode ended."""
    tracking_error: np.ndarray
    """float32, mean over time and both axes of |v_xy - c_xy| in m/s, where each term counts as at
    most twice the command limit."""
    lengths: np.ndarray
    """int32, control steps."""
    finite: np.ndarray
    """bool, False where the simulation became invalid, which ended the episode."""
    seconds: float
    """Wall time of the rollouts."""
    settings: dict
    """Robot, agent, engine, seed and the evaluation's configuration."""

    @property
    def mean(self):
        """Mean return per design, a float or [S]."""
        return float_or_array(self.returns.mean(-1))

    @property
    def mean_tracking_error(self):
        """Mean tracking error per design in m/s, a float or [S]."""
        return float_or_array(self.tracking_error.mean(-1))

    @property
    def non_finite(self):
        """Number of episodes that became invalid, an int or [S]."""
        count = np.sum(~self.finite, -1)
        return int(count) if np.ndim(count) == 0 else count

    def interval(self, confidence: float = CONFIDENCE, seed: int = 0):
        """Bootstrap interval (low, high) of the mean return over episodes, floats or [S] each."""
        return bootstrap_interval(self.returns, confidence=confidence, seed=seed)

    def summary(self) -> str:
        """One line per design: mean return with its interval, tracking error, failures."""
        low, high = (np.atleast_1d(x) for x in self.interval())
        rows = zip(
            np.atleast_1d(self.mean),
            low,
            high,
            np.atleast_1d(self.mean_tracking_error),
            np.atleast_1d(self.lengths.mean(-1)),
            np.atleast_1d(self.non_finite),
            strict=True,
        )
        episodes = self.returns.shape[-1]
        return "\n".join(
            f"return {mean:.2f} [{a:.2f}, {b:.2f}], tracking error {error:.3f} m/s, "
            f"length {length:.0f}, {broken} of {episodes} episodes not finite"
            for mean, a, b, error, length, broken in rows
        )


def evaluate(
    agent: Agent,
    robot: Robot,
    designs,
    episodes: int | None = None,
    seed: int = 0,
    engine: str = "auto",
    config: EvaluationConfig | None = None,
    progress: bool = False,
) -> Evaluation:
    """Roll out the frozen policy with mean actions on one design [d] or several [S, d].

    Episode i of every design has the same random numbers, so that differences between designs are
    paired. Results repeat on the same machine for the same designs, episodes and seed. In another
    batch, float rounding makes single episodes drift apart; only their statistics agree.

    Args:
        agent: its policy is used; any number of joints fits.
        robot: the robot whose designs these are.
        designs: normalized designs in [-1, 1].
        episodes: episodes per design; 200 unless `config` says otherwise.
        seed: of the episodes.
        engine: "native", "mjx" or "auto" (native on a CPU). Besides the arithmetic, their solvers
            differ: "mjx" stops after 4 Newton and 8 line-search iterations (`MjxPhysics`),
            "native" after those of the robot's file.
        config: all other settings.
        progress: print the share of the episodes that is done.

    Raises:
        ValueError: for designs of a wrong length, outside the box or not finite, a wrong number
            of episodes, or an unknown engine.
    """
    # What is asked for.
    require_agent(agent)
    config = EvaluationConfig() if config is None else config
    require_kind("config", config, EvaluationConfig, "shapebody.EvaluationConfig(...)")
    if episodes is not None:
        config = dataclasses.replace(config, episodes=episodes)
    require_seed("seed", seed)
    require_engine("engine", engine)
    require_flag("progress", progress)
    space = DesignSpace(robot)
    designs = space.validate(designs)
    if designs.ndim > 2 or len(designs) == 0:
        raise ValueError(
            f"designs have shape {designs.shape}; expected one design [{space.dim}] or at least "
            f"one row of [S, {space.dim}]"
        )

    # One environment per episode, or equal shares of them where that exceeds `num_envs`.
    rows = np.atleast_2d(designs)
    total = len(rows) * config.episodes
    chunks = -(-total // config.num_envs)
    size = -(-total // chunks)
    env = _environment(robot, size, engine, config.task)

    # All episodes of all designs, and their results as [S, E].
    keys = np.asarray(_episode_keys(seed, config.episodes))
    work = Episodes(rows, keys, config.coefficient, report=_print_share if progress else _silent)
    act, embed = mean_action_policy(agent.policy_config)
    began = time.perf_counter()
    results = play(env, act, functools.partial(embed, agent.policy), work)
    if progress:
        print(flush=True)
    seconds = time.perf_counter() - began
    shape = designs.shape[:-1] + (config.episodes,)
    results = EpisodeResults(*(x.reshape(shape) for x in results))
    return Evaluation(
        **results._asdict(),
        seconds=seconds,
        settings={
            "robot": robot.name,
            "agent": agent.name,
            "agent_hash": agent.hash,
            "engine": env.engine,
            "seed": seed,
            **dataclasses.asdict(config),
        },
    )


def _print_share(share: float) -> None:
    print(f"\revaluated {share:4.0%}", end="", flush=True)


def _silent(share: float) -> None:
    pass


@functools.lru_cache(maxsize=4)
def _environment(robot: Robot, num_envs: int, engine: str, task: TaskConfig) -> Locomotion:
    return Locomotion(robot, num_envs, engine, task, auto_reset=False)


@functools.partial(jax.jit, static_argnums=1)
def _episode_keys(seed, episodes: int):
    # Folding in the number of the episode: more episodes leave the first ones unchanged.
    key = jax.random.PRNGKey(seed)
    return jax.vmap(lambda i: jax.random.fold_in(key, i))(jnp.arange(episodes))
