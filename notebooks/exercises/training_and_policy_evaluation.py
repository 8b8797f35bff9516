"""Exercises of 05_training_and_policy_evaluation."""

import numpy as np

from exercises import checker, need, same


@checker
def check_gae(function):
    """Advantages [T] of an episode that goes on, from (reward, value, last_value, γ, λ)."""
    rng = np.random.default_rng(0)
    for steps, discount, gae_lambda in ((1, 0.9, 0.5), (6, 0.9, 0.0), (9, 0.99, 0.7)):
        reward, value, last = *rng.normal(size=(2, steps)), rng.normal()
        error = reward + discount * np.append(value[1:], last) - value
        powers = (discount * gae_lambda) ** np.arange(steps)
        expected = [error[t:] @ powers[: steps - t] for t in range(steps)]
        right = same(function(reward, value, last, discount, gae_lambda), expected)
        hint = "Begin with last_value at the end, and go backwards: A_t = δ_t + γ λ A_{t+1}."
        need(right, f"{steps} steps, γ = {discount:g}, λ = {gae_lambda:g}: {hint}")
    return "It gives what the agent was trained with."


@checker
def check_surrogate(function):
    """PPO's clipped surrogate with ε = 0.1; function: (ratio, advantage) -> gain, arrays."""
    ratio, advantage = np.meshgrid([0.5, 0.95, 1.0, 1.05, 1.5], [-2.0, 0.0, 1.0])
    clipped, given = np.clip(ratio, 0.9, 1.1) * advantage, function(ratio, advantage)
    need(not same(given, clipped), "Clipping alone would stop the correction of a wrong step.")
    hint = "It is the smaller of ratio × advantage and of that with the ratio within 0.9 … 1.1."
    need(same(given, np.minimum(ratio * advantage, clipped)), hint)
    return "The gain is never above the unclipped one: a pessimistic estimate."
