"""Augmented random search (Appendix C: ARS), V1-t of Mania et al. (2018).

    repeat N times
        draw D directions δ_k ~ N(0, I)
        score f + ν δ_k and f - ν δ_k, clipped to [-1, 1]^d, on one new minibatch of states
        take the b directions whose better side is best
        f <- clip(f + α / (b σ_R) Σ_k [Ĵ(f + ν δ_k) - Ĵ(f - ν δ_k)] δ_k)

σ_R is the standard deviation of the 2 b values.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from shapebody.configuration import Count, Positive, Share, configuration
from shapebody.optimizers.loop import Search, Steps, iterate


@configuration
class ARSConfig:
    """Settings of augmented random search; the defaults are the paper's."""

    iterations: Count = 50
    directions: Count = 16
    """Random directions per iteration, each tried both ways."""
    perturbation_std: Positive = 0.1
    """ν, length of a step by which directions are tried."""
    learning_rate: Positive = 0.05
    """α."""
    top_fraction: Share = 1.0
    """Part of the directions, by the better of their two values, that is used."""

    @property
    def top(self) -> int:
        """Number of directions that are used."""
        return max(1, round(self.top_fraction * self.directions))


class _Point(NamedTuple):
    design: jax.Array  # [d]
    directions: jax.Array  # [D, d] of the next iteration


def ars(objective, starts, key, config: ARSConfig) -> Search:
    """Ascent along differences of the objective in random directions; returns the last design."""
    evaluations = 2 * config.iterations * config.directions
    return iterate(objective, starts, key, config, _STEPS, evaluations)


def _directions(config, key, size):
    return jax.random.normal(key, (config.directions, size))


def _begin(config, start, key):
    return _Point(start, _directions(config, key, len(start)))


def _propose(config, memory, key):
    steps = config.perturbation_std * memory.directions
    both = jnp.concatenate([memory.design + steps, memory.design - steps])
    return jnp.clip(both, -1.0, 1.0)


def _update(config, memory, scored, key):
    pairs = scored.values.reshape(2, -1)
    # A direction of which one side is broken says nothing about the slope.
    valid = jnp.all(jnp.isfinite(pairs), axis=0)
    _, top = jax.lax.top_k(jnp.where(valid, jnp.max(pairs, axis=0), -jnp.inf), config.top)
    used = valid[top]
    pairs = jnp.where(used, pairs[:, top], 0.0)
    spread = jnp.std(pairs, where=jnp.broadcast_to(used, pairs.shape))
    slope = (pairs[0] - pairs[1]) @ memory.directions[top]
    scale = jnp.sum(used) * spread
    step = jnp.where(scale > 0, config.learning_rate * slope / scale, 0.0)
    design = jnp.clip(memory.design + step, -1.0, 1.0)
    return _Point(design, _directions(config, key, len(design)))


_STEPS = Steps(_begin, _propose, _update)
