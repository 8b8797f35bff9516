"""Random search (Appendix C: Random).

    repeat N times
        draw P designs uniformly from [-1, 1]^d
        score them on a new minibatch of states
        best <- the best of them, if its value is above that of the best so far

The value of the best is the one of the minibatch on which it was scored.
"""

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
    """The design with the highest value among uniform draws from the box.

    A start is only row 0 of its trajectory and the source of its random numbers: every start has
    draws of its own, and what is found may be worse than the start.
    """
    evaluations = config.iterations * config.candidates
    return iterate(objective, starts, key, config, _STEPS, evaluations)


def _begin(config, start, key):
    return _Best(start, jnp.float32(-jnp.inf))


def _propose(config, memory, key):
    shape = (config.candidates, len(memory.design))
    return jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)


def _update(config, memory, scored, key):
    best = jnp.argmax(scored.values)
    better = scored.values[best] > memory.value
    return _Best(
        jnp.where(better, scored.designs[best], memory.design),
        jnp.where(better, scored.values[best], memory.value),
    )


_STEPS = Steps(_begin, _propose, _update)
