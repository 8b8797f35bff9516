"""Random search (Appendix C)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from shapebody.configuration import Count, configuration
from shapebody.optimizers.loop import Search, Steps, iterate


@configuration
class RandomConfig:
    """Settings of random search; 50 × 64 are the paper's 3200 designs."""

    iterations: Count = 50
    """Number N of minibatches."""
    candidates: Count = 64
    """Designs drawn and scored per minibatch."""


class _Best(NamedTuple):
    design: jax.Array  # [d]
    value: jax.Array  # []


def random(objective, starts, key, config: RandomConfig) -> Search:
    """The design with the highest value among uniform draws from [-1, 1]^d.

    The start is only row 0 of the trajectory and the source of the random numbers: every start
    has draws of its own, and its result may be worse than the start. A draw keeps the value of
    the minibatch on which it was scored.
    """
    evaluations = config.iterations * config.candidates
    return iterate(objective, starts, key, config, _RANDOM, evaluations)


def _random_begin(config, start, key):
    return _Best(start, jnp.float32(-jnp.inf))


def _random_propose(config, memory, key):
    shape = (config.candidates, len(memory.design))
    return jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)


def _random_update(config, memory, scored, key):
    best = jnp.argmax(scored.values)
    better = scored.values[best] > memory.value
    return _Best(
        jnp.where(better, scored.designs[best], memory.design),
        jnp.where(better, scored.values[best], memory.value),
    )


_RANDOM = Steps(_random_begin, _random_propose, _random_update)
