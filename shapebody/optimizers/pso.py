"""Particle swarm optimization (Appendix C)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from shapebody.configuration import Count, NonNegative, Positive, configuration
from shapebody.optimizers.loop import (
    Search,
    Steps,
    initial_population,
    iterate,
)


@configuration
class PSOConfig:
    """Settings of particle swarm optimization; the defaults are the paper's."""

    iterations: Count = 50
    particles: Count = 32
    inertia: NonNegative = 0.9
    """w, the part of a velocity that is kept."""
    cognitive: NonNegative = 0.5
    """c_1, pull towards a particle's own best design."""
    social: NonNegative = 0.3
    """c_2, pull towards the best design of the swarm."""
    initial_std: Positive | None = None
    """Standard deviation of the initial particles around the start; uniform in the box if None."""


class _Swarm(NamedTuple):
    design: jax.Array  # [d] best design of the swarm
    particles: jax.Array  # [P, d]
    velocities: jax.Array  # [P, d]
    best: jax.Array  # [P, d] best design of every particle
    best_values: jax.Array  # [P]


def pso(objective, starts, key, config: PSOConfig) -> Search:
    """Global-best particle swarm optimization; returns the best design of the swarm.

    v <- w v + c_1 r_1 (own best - x) + c_2 r_2 (swarm's best - x), x <- clip(x + v), with new
    uniform r_1, r_2 for every particle and parameter. Particles begin at rest; at a face of the
    box a velocity loses what would have led outside.
    """
    evaluations = config.iterations * config.particles
    return iterate(objective, starts, key, config, _PSO, evaluations)


def _pso_begin(config, start, key):
    particles = initial_population(config, start, key)
    nothing = jnp.full(config.particles, -jnp.inf)
    return _Swarm(start, particles, jnp.zeros_like(particles), particles, nothing)


def _pso_propose(config, memory, key):
    return memory.particles


def _pso_update(config, memory, scored, key):
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


_PSO = Steps(_pso_begin, _pso_propose, _pso_update)
