"""Value-Gradient Design Search (VGDS, Section 3.2): clipped Adam ascent on the design objective.

    repeat N times
        draw a minibatch B of states
        f <- clip[-1, 1](f + clip[-δ_max, δ_max](Adam(∇ Ĵ_{λ,B}(f))))            (eq. 6 and 7)

"Penalty only" is the same search without the critic.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import optax

from shapebody.configuration import Count, Positive, configuration
from shapebody.optimizers.loop import Search, last_finite, values_and_gradients


@configuration
class VGDSConfig:
    """Settings of VGDS; the defaults are the paper's."""

    iterations: Count = 50
    """Number N of gradient steps."""
    learning_rate: Positive = 0.05
    """Step size of Adam, in units of the normalized design."""
    max_update: Positive = 0.1
    """δ_max, the largest change of one design parameter in one iteration."""


def vgds(objective, starts, key, config: VGDSConfig) -> Search:
    """Gradient ascent on Ĵ_λ from designs `starts` [S, d].

    All starts share the minibatches: they are compared on the same states, and the result of a
    start does not depend on the others. Found is the last design whose objective is finite.
    """
    return _ascend(objective, starts, key, config, True)


def penalty_only(objective, starts, key, config: VGDSConfig) -> Search:
    """VGDS with the value gradient set to zero: ascent on the trust-region penalty only.

    What it gains is due to the reference design and not to the critic. `history` still holds Ĵ_λ.
    """
    return _ascend(objective, starts, key, config, False)


def _ascend(objective, starts, key, config, value_gradient):
    designs, trajectory, history = _run(objective, starts, key, config, value_gradient)
    return Search(designs, trajectory, history, config.iterations)


@partial(jax.jit, static_argnames=("config", "value_gradient"))
def _run(objective, starts, key, config: VGDSConfig, value_gradient: bool):
    adam = optax.adam(config.learning_rate)
    limit = config.max_update

    def score_and_gradient(designs, states):
        if not value_gradient:
            gradient = jax.grad(lambda f: -jnp.sum(objective.penalty(f)))(designs)
            return objective(designs, states), gradient
        return values_and_gradients(objective, designs, states)

    def iteration(carry, key):
        designs, adam_state = carry
        scores, gradient = score_and_gradient(designs, objective.batch(key))
        # Optax minimizes: for an ascent it is given the negative gradient.
        update, adam_state = adam.update(-gradient, adam_state)
        moved = jnp.clip(designs + jnp.clip(update, -limit, limit), -1.0, 1.0)
        return (moved, adam_state), (designs, scores)

    # One gradient more than steps: its score is that of the last design, its step is not taken.
    keys = jax.random.split(key, config.iterations + 1)
    _, (trajectory, history) = jax.lax.scan(iteration, (starts, adam.init(starts)), keys)
    return last_finite(trajectory, history), trajectory, history
