"""The cross-entropy method (Appendix C: CEM).

    m <- start, s <- initial_std
    repeat N times
        draw P designs from N(m, diag(s²)), clipped to [-1, 1]^d
        score them on a new minibatch of states
        m, s <- mean and standard deviation of the elites (the best 20 %), s at least minimum_std

What is found is the last mean: in hundreds of dimensions it is far better than every sample drawn
around it.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from shapebody.configuration import Count, Positive, Share, configuration
from shapebody.optimizers.loop import Search, Steps, iterate


@configuration
class CEMConfig:
    """Settings of the cross-entropy method; the defaults are the paper's."""

    iterations: Count = 50
    particles: Count = 32
    """Samples per iteration."""
    elite_fraction: Share = 0.2
    """Part of the samples to which the Gaussian is fitted."""
    initial_std: Positive = 0.5
    minimum_std: Positive = 0.02
    """Floor of every standard deviation."""

    @property
    def elites(self) -> int:
        """Number of elites, 6 of 32 for the paper's 20 %."""
        return max(1, round(self.elite_fraction * self.particles))


class _Gaussian(NamedTuple):
    design: jax.Array  # [d] mean
    std: jax.Array  # [d]


def cem(objective, starts, key, config: CEMConfig) -> Search:
    """Cross-entropy method with a diagonal Gaussian around the start; returns its last mean."""
    evaluations = config.iterations * config.particles
    return iterate(objective, starts, key, config, _STEPS, evaluations)


def _begin(config, start, key):
    return _Gaussian(start, jnp.full_like(start, config.initial_std))


def _propose(config, memory, key):
    noise = jax.random.normal(key, (config.particles, len(memory.design)))
    return jnp.clip(memory.design + memory.std * noise, -1.0, 1.0)


def _update(config, memory, scored, key):
    values, rows = jax.lax.top_k(scored.values, config.elites)
    elites, valid = scored.designs[rows], jnp.isfinite(values)[:, None]
    mean = jnp.mean(elites, axis=0, where=valid)
    std = jnp.maximum(jnp.std(elites, axis=0, where=valid), config.minimum_std)
    some = jnp.any(valid)
    return _Gaussian(
        jnp.where(some, jnp.clip(mean, -1.0, 1.0), memory.design),
        jnp.where(some, std, memory.std),
    )


_STEPS = Steps(_begin, _propose, _update)
