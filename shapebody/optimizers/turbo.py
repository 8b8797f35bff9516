"""TuRBO, a trust-region search (Appendix C)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from shapebody.configuration import Count, Positive, Share, configuration, number
from shapebody.optimizers.loop import (
    Search,
    Steps,
    iterate,
)


@configuration
class TuRBOConfig:
    """Settings of adaptive trust-region random search; the defaults are the paper's."""

    iterations: Count = 50
    candidates: Count = 64
    """Designs drawn from the trust box per iteration."""
    radius: Positive = 0.1
    """Initial half width of the trust box."""
    minimum_radius: Positive = 0.005
    maximum_radius: Positive = 0.5
    shrink: Share = 0.7
    """Factor on the radius after an iteration without improvement."""
    expand: number("a finite number of at least 1", ge=1) = 1.3
    """Factor on the radius after an improvement."""

    def __post_init__(self):
        low, high = self.minimum_radius, self.maximum_radius
        if not low <= self.radius <= high:
            raise ValueError(
                f"radius is {self.radius}; expected minimum_radius <= radius <= maximum_radius, "
                f"which are {low} and {high}"
            )


class _TrustBox(NamedTuple):
    design: jax.Array  # [d] centre of the box
    radius: jax.Array  # []


def turbo(objective, starts, key, config: TuRBOConfig) -> Search:
    """Uniform draws from a box around the best design, whose size adapts to success.

    The paper's TuRBO has no Gaussian process. If the best candidate of an iteration is better than
    the centre, it becomes the centre and the box grows; otherwise the box shrinks. The centre is
    scored anew with the candidates, so that both are compared on the same states.
    """
    evaluations = config.iterations * (config.candidates + 1)
    return iterate(objective, starts, key, config, _TURBO, evaluations)


def _turbo_begin(config, start, key):
    return _TrustBox(start, jnp.float32(config.radius))


def _turbo_propose(config, memory, key):
    shape = (config.candidates, len(memory.design))
    offsets = jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)
    return jnp.clip(memory.design + memory.radius * offsets, -1.0, 1.0)


def _turbo_update(config, memory, scored, key):
    best = jnp.argmax(scored.values)
    better = scored.values[best] > scored.current
    radius = memory.radius * jnp.where(better, config.expand, config.shrink)
    return _TrustBox(
        jnp.where(better, scored.designs[best], memory.design),
        jnp.clip(radius, config.minimum_radius, config.maximum_radius),
    )


_TURBO = Steps(_turbo_begin, _turbo_propose, _turbo_update)
