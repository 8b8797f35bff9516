"""Augmented random search (Appendix C: ARS): ascent along differences in random directions."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from shapebody.configuration import Count, Positive, Share, configuration
from shapebody.optimizers.loop import (
    Search,
    Steps,
    iterate,
)


@configuration
class ARSConfig:
    """Settings of augmented random search; the defaults are the paper's."""

    iterations: Count = 50
    directions: Count = 16
    """Random directions per iteration, each tried both ways."""
    perturbation_std: Positive = 0.1
    learning_rate: Positive = 0.05
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
    """Augmented random search (Mania et al., V1-t); returns the last design.

    f <- clip(f + α / (b σ_R) Σ_k [Ĵ(f + ν δ_k) - Ĵ(f - ν δ_k)] δ_k) over the b best of D Gaussian
    directions δ_k, with the standard deviation σ_R of the 2 b values. All are of one minibatch.
    """
    evaluations = 2 * config.iterations * config.directions
    return iterate(objective, starts, key, config, _ARS, evaluations)


def _directions(config, key, size):
    return jax.random.normal(key, (config.directions, size))


def _ars_begin(config, start, key):
    return _Point(start, _directions(config, key, len(start)))


def _ars_propose(config, memory, key):
    steps = config.perturbation_std * memory.directions
    both = jnp.concatenate([memory.design + steps, memory.design - steps])
    return jnp.clip(both, -1.0, 1.0)


def _ars_update(config, memory, scored, key):
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


_ARS = Steps(_ars_begin, _ars_propose, _ars_update)
