"""What a rollout returns: T control steps of N environments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from shapebody.design.descriptions import Descriptions
from shapebody.task.episode import Episode, Outcome
from shapebody.task.observations import Observation

PolicyFunction = Callable[[Any, jax.Array, Descriptions, Observation], tuple[jax.Array, Any]]
"""(params, key, descriptions[N], observation[N]) -> (action[N, J], extra pytree[N])."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Trajectory:
    """T control steps of N environments.

    A design is fixed for an episode, so a rollout holds few of them. `descriptions` keeps
    two per environment, the one at the start of the rollout and the one at its end, and
    `slot` says which applies in each step. Steps of an episode that began and ended within
    the rollout have neither; `valid` is 0 there.
    """

    observation: Observation  # [T, N, ...]
    action: jax.Array  # [T, N, J]
    extra: Any  # [T, N, ...] what the policy returned beside the action
    reward: jax.Array  # [T, N]
    terminated: jax.Array  # [T, N] bool
    truncated: jax.Array  # [T, N] bool
    finite: jax.Array  # [T, N] bool
    slot: jax.Array  # [T, N] int32, 0 or 1
    valid: jax.Array  # [T, N] float32
    descriptions: Descriptions  # [2, N, ...]
    last_observation: Observation  # [N, ...] after the last step
    episode_return: jax.Array  # [T, N] return so far
    episode_length: jax.Array  # [T, N] int32, control steps so far
    episode_error: jax.Array  # [T, N] mean over time and axes of |v_xy - c_xy| so far, m/s,
    # each term at most twice the command limit
    coefficient: jax.Array  # [T, N] curriculum coefficient


class StepRecord(NamedTuple):
    """What one control step of N environments adds to a trajectory: fields as there, without T."""

    observation: Observation
    action: jax.Array
    extra: Any
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    finite: jax.Array
    episode_return: jax.Array
    episode_length: jax.Array
    episode_error: jax.Array
    coefficient: jax.Array


def step_record(state: Episode, observation, action, extra, outcome: Outcome) -> StepRecord:
    """The record of one control step; `state` is the one after it, before any new episode."""
    return StepRecord(
        observation=observation,
        action=action,
        extra=extra,
        reward=outcome.reward,
        terminated=outcome.terminated,
        truncated=outcome.truncated,
        finite=outcome.finite,
        episode_return=state.total_reward,
        episode_length=state.step,
        episode_error=state.total_error / jnp.maximum(state.step, 1),
        coefficient=state.coefficient,
    )


def assembled(
    steps: StepRecord, first: Descriptions, last: Descriptions, last_observation, auto_reset: bool
) -> Trajectory:
    """The trajectory of a rollout.

    Args:
        steps: its records, stacked [T, N, ...], all NumPy or all JAX arrays.
        first, last: descriptions [N, ...] before the first and after the last step.
        last_observation: [N, ...] after the last step.
        auto_reset: whether a finished episode was followed by a new one.
    """
    xp = np if isinstance(steps.reward, np.ndarray) else jnp
    done = steps.terminated | steps.truncated
    if not auto_reset:
        done = xp.zeros_like(done)
    # Episode number of each step within this rollout, and of the state after it.
    number = xp.cumsum(done, 0) - done
    final = xp.sum(done, 0)
    return Trajectory(
        **steps._asdict(),
        slot=((number == final) & (final > 0)).astype(np.int32),
        valid=((number == 0) | (number == final)).astype(np.float32),
        descriptions=jax.tree.map(lambda a, b: jnp.stack([a, b]), first, last),
        last_observation=last_observation,
    )
