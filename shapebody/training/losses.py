"""Generalized advantage estimation, as pure functions."""

import jax
import jax.numpy as jnp

from shapebody.arguments import require_shape
from shapebody.task.observations import COMMAND, Observation


def advantages(reward, value, last_value, terminated, truncated, discount, gae_lambda):
    """Generalized advantage estimation over [N, T] (last_value [N]); returns [N, T].

    A terminated episode is worth nothing afterwards, whatever `truncated` says there. A truncated
    one would have gone on: its last state's value stands for that of the next state, one control
    step later.
    """
    for name, array in (("reward", reward), ("value", value), ("terminated", terminated)):
        require_shape(name, array, ("N", "T"))
    for name, array in (("value", value), ("terminated", terminated), ("truncated", truncated)):
        require_shape(name, array, reward.shape)
    require_shape("last_value", last_value, reward.shape[:1])
    done = terminated | truncated
    following = jnp.concatenate([value[:, 1:], last_value[:, None]], 1)
    following = jnp.where(truncated, value, following)
    following = jnp.where(terminated, 0.0, following)
    error = reward + discount * following - value

    def backward(advantage, inputs):
        error, done = inputs
        advantage = error + discount * gae_lambda * jnp.where(done, 0.0, advantage)
        return advantage, advantage

    _, result = jax.lax.scan(backward, jnp.zeros_like(last_value), (error.T, done.T), reverse=True)
    return result.T


def command_changes(observation: Observation, last_observation: Observation):
    """Whether the command of the next step is another one, bool[N, T].

    observation: [N, T, ...]; last_observation: [N, ...], after the last step.
    """
    commands = observation.general[..., COMMAND]
    last = last_observation.general[:, None, COMMAND]
    following = jnp.concatenate([commands[:, 1:], last], 1)
    return jnp.any(following != commands, -1)
