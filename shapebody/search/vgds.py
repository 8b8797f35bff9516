"""Value-Gradient Design Search (Section 3.2): clipped Adam ascent on the design objective."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax


class Search(NamedTuple):
    """What a method returns for S starts."""

    designs: jax.Array  # [S, d] found designs
    trajectory: jax.Array  # [N + 1, S, d] current (or best) design after every iteration
    history: jax.Array  # [N + 1, S] objective of the trajectory on minibatches
    evaluations: int  # designs scored on a minibatch, per start


@dataclass(frozen=True)
class VGDSConfig:
    """Settings of VGDS; the defaults are the paper's."""

    iterations: int = 50
    """Number N of gradient steps."""
    learning_rate: float = 0.05
    """Step size of Adam, in units of the normalized design."""
    max_update: float = 0.1
    """δ_max, the largest change of one design parameter in one iteration."""

    def __post_init__(self):
        if self.iterations != int(self.iterations) or self.iterations < 1:
            raise ValueError(f"iterations is {self.iterations!r}; expected an integer from 1 up")
        for name in ("learning_rate", "max_update"):
            if not 0 < getattr(self, name) < float("inf"):
                raise ValueError(f"{name} is {getattr(self, name)!r}; expected a positive number")


def vgds(objective, starts, key, config: VGDSConfig) -> Search:
    """Gradient ascent on Ĵ_λ (eq. 6 and 7) from designs `starts` [S, d].

    f_{n+1} = clip[-1, 1](f_n + clip[-δ_max, δ_max](Adam(∇ Ĵ_{λ,B}(f_n)))), with a new minibatch
    B of states in every iteration. All starts share the minibatches: they are compared on the same
    states, and the result of a start does not depend on the others.
    """
    return _ascend(objective, starts, key, config, True)


def penalty_only(objective, starts, key, config: VGDSConfig) -> Search:
    """VGDS with the value gradient set to zero: the control that follows the trust region alone.

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

        def total(designs):
            scores = objective(designs, states)
            return jnp.sum(scores), scores

        # Starts are independent, so the gradient of the sum holds the gradient of each.
        (_, scores), gradient = jax.value_and_grad(total, has_aux=True)(designs)
        return scores, gradient

    def iteration(carry, key):
        designs, adam_state = carry
        scores, gradient = score_and_gradient(designs, objective.batch(key))
        # One broken gradient would stay in Adam's moments for good.
        gradient = jnp.where(jnp.isfinite(gradient), gradient, 0.0)
        update, adam_state = adam.update(-gradient, adam_state)
        moved = jnp.clip(designs + jnp.clip(update, -limit, limit), -1.0, 1.0)
        return (moved, adam_state), (designs, scores)

    # One gradient more than steps: its score is that of the last design, its step is not taken.
    keys = jax.random.split(key, config.iterations + 1)
    _, (trajectory, history) = jax.lax.scan(iteration, (starts, adam.init(starts)), keys)
    return trajectory[-1], trajectory, history
