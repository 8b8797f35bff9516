"""Particle swarm, cross-entropy and differential evolution (Appendix C: PSO, CEM, DE).

The paper gives no initial population for PSO and DE. Here it is the textbooks' one, uniform in
[-1, 1]^d, with the start design as its first particle. The mean of such a population is the centre
of the box, which is the reference design if that is f = 0: what PSO and DE gain by it, they would
gain without a critic too. `initial_std` puts the population around the start instead.

The first iteration scores the initial population. A design that is kept keeps the value of the
minibatch on which it was scored, as in the textbooks. The minibatch shifts the values of all
designs alike, by little beside the differences that these methods still find at d > 300.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from shapebody.search.loop import (
    Search,
    Steps,
    iterate,
    require,
    require_integers,
    require_positive,
)


def _initial(config, start, key):
    """Initial population [P, d], the start [d] first; uniform, or Gaussian around the start."""
    shape = (config.particles, len(start))
    if config.initial_std is None:
        others = jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)
    else:
        others = jnp.clip(start + config.initial_std * jax.random.normal(key, shape), -1.0, 1.0)
    return others.at[0].set(start)


def _require_std(config):
    if config.initial_std is not None:
        require_positive(config, "initial_std")


@dataclass(frozen=True)
class PSOConfig:
    """Settings of particle swarm optimization; the defaults are the paper's."""

    iterations: int = 50
    particles: int = 32
    inertia: float = 0.9
    """w, the part of a velocity that is kept."""
    cognitive: float = 0.5
    """c_1, pull towards a particle's own best design."""
    social: float = 0.3
    """c_2, pull towards the best design of the swarm."""
    initial_std: float | None = None
    """Standard deviation of the initial particles around the start; uniform in the box if None."""

    def __post_init__(self):
        require_integers(self, "iterations", "particles")
        expected = "a finite number of at least 0"
        names = ("inertia", "cognitive", "social")
        require(self, expected, lambda x: 0 <= x < float("inf"), *names)
        _require_std(self)


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
    particles = _initial(config, start, key)
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


@dataclass(frozen=True)
class CEMConfig:
    """Settings of the cross-entropy method; the defaults are the paper's."""

    iterations: int = 50
    particles: int = 32
    """Samples per iteration."""
    elite_fraction: float = 0.2
    """Part of the samples to which the Gaussian is fitted."""
    initial_std: float = 0.5
    minimum_std: float = 0.02
    """Floor of every standard deviation."""

    def __post_init__(self):
        require_integers(self, "iterations", "particles")
        require(self, "a number above 0 and at most 1", lambda x: 0 < x <= 1, "elite_fraction")
        require_positive(self, "initial_std", "minimum_std")

    @property
    def elites(self) -> int:
        """Number of elites, 6 of 32 for the paper's 20 %."""
        return max(1, round(self.elite_fraction * self.particles))


class _Gaussian(NamedTuple):
    design: jax.Array  # [d] mean
    std: jax.Array  # [d]


def cem(objective, starts, key, config: CEMConfig) -> Search:
    """Cross-entropy method with a diagonal Gaussian around the start; returns its final mean.

    In hundreds of dimensions the mean is far better than every sample drawn around it.
    """
    evaluations = config.iterations * config.particles
    return iterate(objective, starts, key, config, _CEM, evaluations)


def _cem_begin(config, start, key):
    return _Gaussian(start, jnp.full_like(start, config.initial_std))


def _cem_propose(config, memory, key):
    noise = jax.random.normal(key, (config.particles, len(memory.design)))
    return jnp.clip(memory.design + memory.std * noise, -1.0, 1.0)


def _cem_update(config, memory, scored, key):
    values, rows = jax.lax.top_k(scored.values, config.elites)
    elites, valid = scored.designs[rows], jnp.isfinite(values)[:, None]
    mean = jnp.mean(elites, axis=0, where=valid)
    std = jnp.maximum(jnp.std(elites, axis=0, where=valid), config.minimum_std)
    some = jnp.any(valid)
    return _Gaussian(
        jnp.where(some, jnp.clip(mean, -1.0, 1.0), memory.design),
        jnp.where(some, std, memory.std),
    )


_CEM = Steps(_cem_begin, _cem_propose, _cem_update)


@dataclass(frozen=True)
class DEConfig:
    """Settings of differential evolution; the defaults are the paper's."""

    iterations: int = 50
    particles: int = 32
    weight: float = 0.5
    """Differential weight F."""
    crossover: float = 0.9
    """CR, probability that a parameter comes from the mutant."""
    initial_std: float | None = None
    """Standard deviation of the initial particles around the start; uniform in the box if None."""

    def __post_init__(self):
        require_integers(self, "iterations")
        require_integers(self, "particles", least=4)
        require(self, "a number from 0 to 2", lambda x: 0 <= x <= 2, "weight")
        require(self, "a probability", lambda x: 0 <= x <= 1, "crossover")
        _require_std(self)


class _Population(NamedTuple):
    design: jax.Array  # [d] best design of the population
    particles: jax.Array  # [P, d]
    values: jax.Array  # [P]
    iteration: jax.Array  # []


def de(objective, starts, key, config: DEConfig) -> Search:
    """Differential evolution (rand/1/bin); returns the best design of the population.

    For every particle, the mutant a + F (b - c) of three other particles is crossed with it, and
    the clipped trial takes its place if it is better.
    """
    evaluations = config.iterations * config.particles
    return iterate(objective, starts, key, config, _DE, evaluations)


def _de_begin(config, start, key):
    particles = _initial(config, start, key)
    return _Population(start, particles, jnp.full(config.particles, -jnp.inf), jnp.int32(0))


def _de_propose(config, memory, key):
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


def _de_update(config, memory, scored, key):
    better = scored.values > memory.values
    particles = jnp.where(better[:, None], scored.designs, memory.particles)
    values = jnp.maximum(scored.values, memory.values)
    best = jnp.argmax(values)
    design = jnp.where(values[best] > -jnp.inf, particles[best], memory.design)
    return _Population(design, particles, values, memory.iteration + 1)


_DE = Steps(_de_begin, _de_propose, _de_update)
