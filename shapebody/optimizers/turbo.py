"""TuRBO, random search in a box that adapts (Appendix C: TuRBO).

    r <- radius, f <- start
    repeat N times
        draw P designs uniformly from the box f ± r, clipped to [-1, 1]^d
        score them, and f itself, on a new minibatch of states
        if the best of them is better than f: f <- that one, r <- expand r
        otherwise:                            r <- shrink r
        clip r to [minimum_radius, maximum_radius]

The paper's TuRBO has no Gaussian process, unlike the method that it is named after.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from shapebody.configuration import Count, Positive, Share, configuration, number
from shapebody.optimizers.loop import Search, Steps, iterate


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
        if low > high:
            raise ValueError(
                f"minimum_radius is {low}; expected at most maximum_radius, which is {high}"
            )
        if not low <= self.radius <= high:
            raise ValueError(
                f"radius is {self.radius}; expected a number from minimum_radius to "
                f"maximum_radius, which are {low} and {high}"
            )


class _TrustBox(NamedTuple):
    design: jax.Array  # [d] centre of the box
    radius: jax.Array  # []


def turbo(objective, starts, key, config: TuRBOConfig) -> Search:
    """Uniform draws from a box around the best design, whose size adapts to success.

    The centre is scored again in every iteration, so that it is compared with the candidates on
    the same states.
    """
    evaluations = config.iterations * (config.candidates + 1)
    return iterate(objective, starts, key, config, _STEPS, evaluations)


def _begin(config, start, key):
    return _TrustBox(start, jnp.float32(config.radius))


def _propose(config, memory, key):
    shape = (config.candidates, len(memory.design))
    offsets = jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)
    return jnp.clip(memory.design + memory.radius * offsets, -1.0, 1.0)


def _update(config, memory, scored, key):
    best = jnp.argmax(scored.values)
    better = scored.values[best] > scored.current
    radius = memory.radius * jnp.where(better, config.expand, config.shrink)
    return _TrustBox(
        jnp.where(better, scored.designs[best], memory.design),
        jnp.clip(radius, config.minimum_radius, config.maximum_radius),
    )


_STEPS = Steps(_begin, _propose, _update)
