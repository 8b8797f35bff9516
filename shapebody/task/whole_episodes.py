"""Whole episodes of many designs: each is played to its end, once.

Training cuts rollouts at a fixed length and begins a new body wherever an episode ends. To judge
designs, the same episodes are played with every design, and each counts as a whole.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from shapebody.task.batch import RESET_SLOTS
from shapebody.task.env import Locomotion
from shapebody.task.trajectory import PolicyFunction

CALLS = 50
"""Control steps between two reports, and per call of an engine that runs whole rollouts."""


class EpisodeResults(NamedTuple):
    """One entry per episode."""

    returns: np.ndarray
    """float32, undiscounted sum of rewards until the episode ended."""
    tracking_error: np.ndarray
    """float32, mean over time and both axes of |v_xy - c_xy| in m/s, each term at most twice the
    command limit."""
    lengths: np.ndarray
    """int32, control steps."""
    finite: np.ndarray
    """bool, False where the simulation became invalid, which ended the episode."""


@dataclass(frozen=True, eq=False)
class Episodes:
    """Which episodes to play: all E of every one of S designs, or one of each design.

    Number n is episode n % E of design n // E; with `one_each` (S = E), episode n of design n.
    """

    designs: np.ndarray
    """[S, d], normalized."""
    keys: np.ndarray
    """[E, ...] PRNG keys, one per episode."""
    coefficient: float = 1.0
    """Curriculum coefficient c of all episodes."""
    one_each: bool = False
    """Whether each design has one episode of its own, instead of all having the same ones."""
    report: Callable[[float], Any] = lambda share: None
    """Called now and then with the share that is done, 0 to 1."""

    @property
    def total(self) -> int:
        """Number of episodes, S x E or S."""
        return len(self.designs) * (1 if self.one_each else len(self.keys))

    def of(self, numbers):
        """Designs [n, d] and keys [n, ...] of episodes."""
        pairs = (numbers, numbers) if self.one_each else np.divmod(numbers, len(self.keys))
        design, episode = pairs
        return self.designs[design], self.keys[episode]

    def begin(self, env: Locomotion, numbers):
        """Start these episodes in all environments."""
        designs, keys = self.of(numbers)
        key = jax.random.PRNGKey(0)  # the episodes have their own
        return env.reset(key, designs, self.coefficient, keys=jnp.asarray(keys))

    def empty(self) -> EpisodeResults:
        """Results to be filled in."""
        return EpisodeResults(
            returns=np.zeros(self.total, np.float32),
            tracking_error=np.zeros(self.total, np.float32),
            lengths=np.zeros(self.total, np.int32),
            finite=np.ones(self.total, bool),
        )


def play(env: Locomotion, policy: PolicyFunction, prepare, episodes: Episodes) -> EpisodeResults:
    """Play episodes to their ends, as many side by side as `env` has environments.

    Args:
        env: of one robot, or with as many environments as there are episodes; `auto_reset=False`.
        policy: acts without random numbers: it is given the same key in every step.
        prepare: descriptions [N] -> the policy's parameters for these bodies.
        episodes: which ones.

    Returns:
        Their results by number.
    """
    queued = env.engine == "native"
    return (_queued if queued else _chunked)(env, policy, prepare, episodes)


def _queued(env: Locomotion, policy, prepare, episodes: Episodes) -> EpisodeResults:
    """Native engine: an environment whose episode has ended takes the next one."""
    # The first episodes, one in every environment.
    results = episodes.empty()
    number = np.arange(env.num_envs)  # the episode in each environment
    following = env.num_envs
    state = episodes.begin(env, number)
    params = prepare(state.descriptions)
    key = jax.random.PRNGKey(0)
    running = np.ones(env.num_envs, bool)
    step = 0
    while running.any():
        # One control step, and the results of the episodes that it ended.
        state, record, _ = env.step(policy, params, state, key, running)
        ended = running & (record.terminated | record.truncated)
        _store(results, number[ended], record, ended)
        running &= ~ended
        left = episodes.total - following
        idle = np.flatnonzero(~running)[:left]
        # The next episodes. Their start is compiled for several at once, so some wait for others.
        if left and len(idle) >= min(RESET_SLOTS, left, env.num_envs):
            number[idle] = np.arange(following, following + len(idle))
            following += len(idle)
            designs, keys = episodes.of(number[idle])
            state = env.restart(state, idle, keys, designs, episodes.coefficient)
            params = prepare(state.descriptions)
            running[idle] = True
        step += 1
        if step % CALLS == 0 or not running.any():
            # An episode under way counts by the share of the horizon that is behind it.
            part = np.sum(record.episode_length[running]) / env.config.horizon
            episodes.report((following - running.sum() + part) / episodes.total)
    return results


def _chunked(env: Locomotion, policy, prepare, episodes: Episodes) -> EpisodeResults:
    """MJX: one episode in every environment, until all have ended; then the next ones."""
    results = episodes.empty()
    key = jax.random.PRNGKey(0)
    length = min(CALLS, env.config.horizon)
    for first in range(0, episodes.total, env.num_envs):
        # The last chunk is filled up with its own last episode.
        number = np.minimum(np.arange(first, first + env.num_envs), episodes.total - 1)
        state = episodes.begin(env, number)
        params = prepare(state.descriptions)
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
            episodes.report(min(first + share * env.num_envs, episodes.total) / episodes.total)
    return results


def _store(results: EpisodeResults, numbers, record, ended) -> None:
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
