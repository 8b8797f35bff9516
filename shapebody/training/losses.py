"""The losses of decoupled PPO, as pure functions of arrays that any trainer can call.

Arrays have one entry per control step, [N, T] for N environments and T steps unless said
otherwise. Weights w are those of `step_weights`: they sum to 1 over the steps that count. Nothing
here knows a network; what a trainer does with these functions is in `update.py`.

Three policies occur in decoupled PPO (Hilton et al., 2022), since rollouts may be older than the
update that learns from them: μ, which acted; π_old, the policy at the start of the update, to which
the clip ε keeps π close; and π, which is learned. The losses take π / π_old as a ratio and
π_old / μ as a truncated importance weight. With μ = π_old, this is PPO. In the code, log
densities under them are `behaviour` (μ; in a rollout its `extra`), `proximal` (π_old) and
`log_prob` (π).
"""

import jax
import jax.numpy as jnp

from shapebody.arguments import require_shape
from shapebody.networks.policy import entropy
from shapebody.task.observations import COMMAND, Observation

# ------------------------------------------------------------------ advantages


def advantages(reward, value, last_value, terminated, truncated, discount, gae_lambda):
    """Generalized advantage estimation over [N, T] (last_value [N]); returns [N, T].

        δ_t = r_t + γ V(s_{t+1}) - V(s_t),    A_t = δ_t + γ λ A_{t+1}

    A terminated episode is worth nothing afterwards, whatever `truncated` says there. A truncated
    one would have gone on: its last state's value stands for that of the next state, one control
    step later. Neither passes A_{t+1} on. A + V are the TD(λ) targets of the critic.

    Args:
        reward, value: r_t and V(s_t).
        last_value: V of the state after the last step.
        terminated, truncated: bool, how an episode ended in that step.
        discount: γ, 0 to 1.
        gae_lambda: λ, the GAE parameter, 0 to 1; not the λ of the design search.

    Raises:
        ValueError: for arrays of other shapes.
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


# ------------------------------------------------------------------ weights of steps


def step_weights(valid):
    """w = valid / max(Σ valid, 1): equal weights of the steps whose `valid` is 1, 0 of the rest."""
    return valid / jnp.maximum(jnp.sum(valid), 1.0)


def moments(x, valid):
    """Mean and variance of x over the steps whose `valid` is 1; NaN if there is none."""
    total = jnp.sum(valid)
    mean = jnp.sum(x * valid) / total
    return mean, jnp.sum((x - mean) ** 2 * valid) / total


def normalized(advantage, valid):
    """(A - mean) / (deviation + 1e-8), over the steps whose `valid` is 1."""
    mean, variance = moments(advantage, valid)
    return (advantage - mean) / (jnp.sqrt(variance) + 1e-8)


# ------------------------------------------------------------------ the policy


def importance_weight(proximal, behaviour, limit: float = 2.0):
    """ρ = min(π_old / μ, limit), from the log densities of the actions under π_old and μ."""
    return jnp.minimum(jnp.exp(proximal - behaviour), limit)


def policy_ratio(log_prob, proximal, valid):
    """(π / π_old, its logarithm), from the log densities of the actions under π and π_old.

    Where `valid` is 0, the ratio is 1: those steps were computed with another body, and their
    densities may be anything. The logarithm enters the exponential within ±20.
    """
    log_ratio = jnp.where(valid > 0, log_prob - proximal, 0.0)
    return jnp.exp(jnp.clip(log_ratio, -20.0, 20.0)), log_ratio


def surrogate_loss(ratio, advantage, importance, weight, clip_range):
    """The clipped surrogate of decoupled PPO, to be minimized; a number.

        L = -Σ w ρ min(x A, clip(x, 1 - ε, 1 + ε) A)    with x = π / π_old and ρ of μ

    Args:
        ratio: x, from `policy_ratio`.
        advantage: A, usually `normalized`.
        importance: ρ, from `importance_weight`; 1 where the rollout is of π_old.
        weight: w.
        clip_range: ε.
    """
    clipped = jnp.clip(ratio, 1 - clip_range, 1 + clip_range)
    gain = jnp.minimum(ratio * advantage, clipped * advantage) * importance
    return -jnp.sum(gain * weight)


def entropy_bonus(std, mask, weight):
    """Σ w H(π): mean entropy in nats of actions with standard deviations `std` [N, T, J].

    mask: [N, T, J] or [N, 1, J], 1 for real joints, 0 for padding.
    """
    return jnp.sum(entropy(std, mask) * weight)


def approximate_kl(ratio, log_ratio, weight):
    """Σ w (x - 1 - log x): an estimate of KL(π_old || π) that is never negative."""
    return jnp.sum((ratio - 1 - log_ratio) * weight)


def clipped_share(ratio, weight, clip_range):
    """Σ w [|x - 1| > ε]: the share of actions at which the surrogate may be clipped."""
    return jnp.sum((jnp.abs(ratio - 1) > clip_range) * weight)


# ------------------------------------------------------------------ the critic


def value_loss(values, target, weight):
    """½ Σ w mean_k (V_k - G)²; a number.

    values: V_k [N, T, K] of the critic's heads; target: G, the TD(λ) return; weight: w.
    """
    error = jnp.mean((values - target[..., None]) ** 2, -1)
    return 0.5 * jnp.sum(error * weight)
