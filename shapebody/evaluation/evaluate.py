"""Returns of designs: rollouts of the frozen policy, the same episodes with every design."""

from __future__ import annotations

import dataclasses
import functools
import time
from dataclasses import dataclass, field
from typing import NamedTuple

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
from shapebody.networks.config import PolicyConfig
from shapebody.networks.policy import Policy
from shapebody.robot.robot import Robot
from shapebody.task.batch import RESET_SLOTS
from shapebody.task.config import TaskConfig
from shapebody.task.env import Locomotion

_CALLS = 50
"""Control steps between two reports, and per call of an engine that runs whole rollouts."""

Episodes = integer(1, MOST_EPISODES)
Coefficient = number("a number from 0 to 1", ge=0, le=1)


@configuration
class EvaluationConfig:
    """How designs are evaluated: 200 episodes as in the paper, with `TaskConfig.evaluation`."""

    episodes: Episodes = 200
    """Episodes per design."""
    coefficient: Coefficient = 1.0
    """Curriculum coefficient c of all episodes, in [0, 1]."""
    task: TaskConfig = field(default_factory=TaskConfig.evaluation)
    """Settings of the task."""
    num_envs: Episodes = 512
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
    keys = np.asarray(_episode_keys(seed, config.episodes))
    work = _Work(rows, keys, config, progress)

    # All episodes of all designs, and their results as [S, E].
    began = time.perf_counter()
    results = _queued(env, agent, work) if env.engine == "native" else _chunked(env, agent, work)
    if progress:
        print(flush=True)
    seconds = time.perf_counter() - began
    shape = designs.shape[:-1] + (config.episodes,)
    results = _Episodes(*(x.reshape(shape) for x in results))
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


class _Episodes(NamedTuple):
    """One entry per episode."""

    returns: np.ndarray
    tracking_error: np.ndarray
    lengths: np.ndarray
    finite: np.ndarray


@dataclass(frozen=True)
class _Work:
    """All episodes of an evaluation; number n is episode n % E of design n // E."""

    designs: np.ndarray  # [S, d]
    keys: np.ndarray  # [E, ...]
    config: EvaluationConfig
    progress: bool

    @property
    def total(self) -> int:
        return len(self.designs) * len(self.keys)

    def begin(self, env: Locomotion, numbers):
        """Start these episodes in all environments."""
        designs, keys = self.of(numbers)
        key = jax.random.PRNGKey(0)  # the episodes have their own
        return env.reset(key, designs, self.config.coefficient, keys=jnp.asarray(keys))

    def of(self, numbers):
        """Designs [n, d] and keys [n, ...] of episodes."""
        design, episode = np.divmod(numbers, len(self.keys))
        return self.designs[design], self.keys[episode]

    def empty(self) -> _Episodes:
        return _Episodes(
            returns=np.zeros(self.total, np.float32),
            tracking_error=np.zeros(self.total, np.float32),
            lengths=np.zeros(self.total, np.int32),
            finite=np.ones(self.total, bool),
        )

    def report(self, done: float):
        if self.progress:
            print(f"\revaluated {done / self.total:4.0%}", end="", flush=True)


def _queued(env: Locomotion, agent: Agent, work: _Work) -> _Episodes:
    """Native engine: an environment whose episode has ended takes the next one."""
    # The first episodes, one in every environment.
    policy, embed = _policy(agent.policy_config), _embed(agent.policy_config)
    results = work.empty()
    number = np.arange(env.num_envs)  # the episode in each environment
    following = env.num_envs
    state = work.begin(env, number)
    params = embed(agent.policy, state.descriptions)
    key = jax.random.PRNGKey(0)  # mean actions need no random numbers
    running = np.ones(env.num_envs, bool)
    step = 0
    while running.any():
        # One control step, and the results of the episodes that it ended.
        state, record, _ = env.step(policy, params, state, key, running)
        ended = running & (record.terminated | record.truncated)
        _store(results, number[ended], record, ended)
        running &= ~ended
        left = work.total - following
        idle = np.flatnonzero(~running)[:left]
        # The next episodes. Their start is compiled for several at once, so some wait for others.
        if left and len(idle) >= min(RESET_SLOTS, left, env.num_envs):
            number[idle] = np.arange(following, following + len(idle))
            following += len(idle)
            designs, keys = work.of(number[idle])
            state = env.restart(state, idle, keys, designs, work.config.coefficient)
            params = embed(agent.policy, state.descriptions)
            running[idle] = True
        step += 1
        if step % _CALLS == 0 or not running.any():
            # An episode under way counts by the share of the horizon that is behind it.
            part = np.sum(record.episode_length[running]) / env.config.horizon
            work.report(following - running.sum() + part)
    return results


def _chunked(env: Locomotion, agent: Agent, work: _Work) -> _Episodes:
    """MJX: one episode in every environment, until all have ended; then the next ones."""
    policy, embed = _policy(agent.policy_config), _embed(agent.policy_config)
    results = work.empty()
    key = jax.random.PRNGKey(0)
    length = min(_CALLS, env.config.horizon)
    for first in range(0, work.total, env.num_envs):
        # The last chunk is filled up with its own last episode.
        number = np.minimum(np.arange(first, first + env.num_envs), work.total - 1)
        state = work.begin(env, number)
        params = embed(agent.policy, state.descriptions)
        running = np.ones(env.num_envs, bool)
        step = 0
        while running.any():
            state, trajectory = env.rollout(policy, params, state, key, length)
            for record in _rows(trajectory, length):
                ended = running & (record.terminated | record.truncated)
                _store(results, number[ended], record, ended)
                running &= ~ended
            step += length
            share = step / env.config.horizon if running.any() else 1.0
            work.report(min(first + share * env.num_envs, work.total))
    return results


def _store(results: _Episodes, numbers, record, ended) -> None:
    results.returns[numbers] = record.episode_return[ended]
    results.tracking_error[numbers] = record.episode_error[ended]
    results.lengths[numbers] = record.episode_length[ended]
    results.finite[numbers] = record.finite[ended]


class _Row(NamedTuple):
    terminated: np.ndarray
    truncated: np.ndarray
    finite: np.ndarray
    episode_return: np.ndarray
    episode_error: np.ndarray
    episode_length: np.ndarray


def _rows(trajectory, length: int):
    columns = [np.asarray(getattr(trajectory, name)) for name in _Row._fields]
    return [_Row(*(column[t] for column in columns)) for t in range(length)]


@functools.lru_cache
def _policy(config: PolicyConfig):
    """Mean actions for `Locomotion`; params are the variables and the embedded descriptions."""
    module = Policy(config)

    def act(params, key, descriptions, observation):
        variables, embedding = params
        mean, _ = module.apply(variables, embedding, descriptions, observation, method="act")
        return mean, ()

    return act


@functools.lru_cache
def _embed(config: PolicyConfig):
    module = Policy(config)

    def embed(variables, descriptions):
        return variables, module.apply(variables, descriptions, method="embed")

    return jax.jit(embed)


@functools.lru_cache(maxsize=4)
def _environment(robot: Robot, num_envs: int, engine: str, task: TaskConfig) -> Locomotion:
    return Locomotion(robot, num_envs, engine, task, auto_reset=False)


@functools.partial(jax.jit, static_argnums=1)
def _episode_keys(seed, episodes: int):
    # Folding in the number of the episode: more episodes leave the first ones unchanged.
    key = jax.random.PRNGKey(seed)
    return jax.vmap(lambda i: jax.random.fold_in(key, i))(jnp.arange(episodes))
