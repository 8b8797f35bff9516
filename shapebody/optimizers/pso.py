"""Particle swarm optimization (Appendix C: PSO).

    x <- initial population, v <- 0
    repeat N times
        score the particles x on a new minibatch of states
        own <- the best design of every particle so far, leader <- the best of all
        v <- w v + c_1 r_1 (own - x) + c_2 r_2 (leader - x),   r_1, r_2 ~ U(0, 1), new for every
                                                               particle and parameter
        x <- clip(x + v), v <- what x has moved

The paper does not say how the population begins: see `loop.initial_population`. A design that is
kept keeps the value of the minibatch on which it was scored, as in the textbooks. A minibatch
shifts the values of all designs by about the same, which is little compared with the differences
that are still found at d > 300.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from shapebody.configuration import Count, NonNegative, Positive, configuration
from shapebody.optimizers.loop import Search, Steps, initial_population, iterate


@configuration
class PSOConfig:
    """Settings of particle swarm optimization; the defaults are the paper's."""

    iterations: Count = 50
    particles: Count = 32
    inertia: NonNegative = 0.9
    """w, the part of a velocity that is kept."""
    cognitive: NonNegative = 0.5
    """c_1, attraction of a particle's own best design."""
    social: NonNegative = 0.3
    """c_2, attraction of the best design of the swarm."""
    initial_std: Positive | None = None
    """Standard deviation of the initial particles around the start; uniform in the box if None."""


class _Swarm(NamedTuple):
    design: jax.Array  # [d] best design of the swarm
    particles: jax.Array  # [P, d]
    velocities: jax.Array  # [P, d]
    best: jax.Array  # [P, d] best design of every particle
    best_values: jax.Array  # [P]


def pso(objective, starts, key, config: PSOConfig) -> Search:
    """Particle swarm with one leader; returns the best design of the swarm.

    Particles begin at rest; at a face of the box a velocity loses what would have led outside.
    """
    evaluations = config.iterations * config.particles
    return iterate(objective, starts, key, config, _STEPS, evaluations)


def _begin(config, start, key):
    particles = initial_population(config, start, key)
    nothing = jnp.full(config.particles, -jnp.inf)
    return _Swarm(start, particles, jnp.zeros_like(particles), particles, nothing)


def _propose(config, memory, key):
    return memory.particles


def _update(config, memory, scored, key):
    better = scored.values > memory.best_values
    best = jnp.where(better[:, None], scored.designs, memory.best)
    best_values = jnp.maximum(scored.values, memory.best_values)
    leader = jnp.argmax(best_values)
    design = jnp.where(best_values[leader] > -jnp.inf, best[leader], memory.design)
    own, social = jax.random.uniform(key, (2, *memory.particles.shape))
    velocities = (
        config.inertia * memory.velocities
        + config.cognitive * own * (best - memory.particles)
        + config.social * social * (design - memory.particles)
    )
    moved = jnp.clip(memory.particles + velocities, -1.0, 1.0)
    return _Swarm(design, moved, moved - memory.particles, best, best_values)


_STEPS = Steps(_begin, _propose, _update)
