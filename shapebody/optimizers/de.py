"""Differential evolution (Appendix C: DE), in its form rand/1/bin.

    x <- initial population, scored on the first minibatch of states
    repeat N - 1 times
        for every particle x_i
            mutant <- a + F (b - c),   a, b, c three other particles, drawn at random
            trial <- x_i with each parameter, at least one, from the mutant with probability CR
        score the trials, clipped to [-1, 1]^d, on a new minibatch
        x_i <- its trial, where that is better

The paper does not say how the population begins: see `loop.initial_population`. A design that is
kept keeps the value of the minibatch on which it was scored, as in the textbooks (see `pso`).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from shapebody.configuration import Count, Positive, Probability, configuration, integer, number
from shapebody.optimizers.loop import Search, Steps, initial_population, iterate


@configuration
class DEConfig:
    """Settings of differential evolution; the defaults are the paper's."""

    iterations: Count = 50
    particles: integer(4) = 32
    weight: number("a number from 0 to 2", ge=0, le=2) = 0.5
    """Differential weight F."""
    crossover: Probability = 0.9
    """CR, probability that a parameter comes from the mutant."""
    initial_std: Positive | None = None
    """Standard deviation of the initial particles around the start; uniform in the box if None."""


class _Population(NamedTuple):
    design: jax.Array  # [d] best design of the population
    particles: jax.Array  # [P, d]
    values: jax.Array  # [P]
    iteration: jax.Array  # []


def de(objective, starts, key, config: DEConfig) -> Search:
    """Differential evolution; returns the best design of the population.

    The first iteration scores the initial population.
    """
    evaluations = config.iterations * config.particles
    return iterate(objective, starts, key, config, _STEPS, evaluations)


def _begin(config, start, key):
    particles = initial_population(config, start, key)
    return _Population(start, particles, jnp.full(config.particles, -jnp.inf), jnp.int32(0))


def _propose(config, memory, key):
    count, size = memory.particles.shape

    def trial(index, particle, key):
        others_key, cross_key, forced_key = jax.random.split(key, 3)
        others = jax.random.choice(others_key, count - 1, (3,), replace=False)
        a, b, c = memory.particles[others + (others >= index)]
        crossed = jax.random.uniform(cross_key, (size,)) < config.crossover
        # At least one parameter comes from the mutant.
        crossed = crossed.at[jax.random.randint(forced_key, (), 0, size)].set(True)
        return jnp.where(crossed, jnp.clip(a + config.weight * (b - c), -1.0, 1.0), particle)

    keys = jax.random.split(key, count)
    trials = jax.vmap(trial)(jnp.arange(count), memory.particles, keys)
    return jnp.where(memory.iteration == 0, memory.particles, trials)


def _update(config, memory, scored, key):
    better = scored.values > memory.values
    particles = jnp.where(better[:, None], scored.designs, memory.particles)
    values = jnp.maximum(scored.values, memory.values)
    best = jnp.argmax(values)
    design = jnp.where(values[best] > -jnp.inf, particles[best], memory.design)
    return _Population(design, particles, values, memory.iteration + 1)


_STEPS = Steps(_begin, _propose, _update)
