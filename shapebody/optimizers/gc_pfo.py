"""Gradient-covariance particle filter optimization (Appendix C: GC-PFO).

    every region begins as the start, with isotropic noise of size `step_size` around it
    repeat N times, in every region
        score the particles and their gradients g on a new minibatch of states
        w ∝ exp((Ĵ - max Ĵ) / (τ std Ĵ))                         weights
        x <- particles resampled with weights w, moved by noise of covariance C = Σ w g gᵀ
        the best particle stays as it is
        τ and the noise fall linearly, to zero at the end

The paper names the method (Vaish and Brock, 2026) and its settings, and describes it in one
sentence: particles are resampled by their objective values and moved by exploration noise with the
covariance of the gradients. The rest is chosen here. The noise is scaled so that a parameter moves
by `step_size` in the root mean square. It goes along the directions in which the objective changes,
and either way: the choice between them is left to the resampling.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from shapebody.configuration import Count, Positive, configuration, integer
from shapebody.optimizers.loop import Search, Steps, iterate


@configuration
class GCPFOConfig:
    """Settings of GC-PFO; the defaults are the paper's."""

    iterations: Count = 50
    regions: Count = 2
    """Populations, each with its own resampling and gradient covariance."""
    particles: integer(2) = 32
    """Particles per region."""
    step_size: Positive = 0.2
    """Root mean square of the first noise on a parameter."""
    temperature: Positive = 1.0
    """τ_0, of the first resampling."""
    epsilon: Positive = 1e-8
    """ε, keeps divisions finite where the spread or all gradients are zero."""


class _Regions(NamedTuple):
    design: jax.Array  # [d] best particle of the last iteration
    particles: jax.Array  # [R, P, d]
    iteration: jax.Array  # []


def gc_pfo(objective, starts, key, config: GCPFOConfig) -> Search:
    """Particle filter whose exploration follows the gradients; returns the best last particle."""
    evaluations = config.iterations * config.regions * config.particles
    return iterate(objective, starts, key, config, _STEPS, evaluations)


def _begin(config, start, key):
    shape = (config.regions, config.particles, len(start))
    noise = (config.step_size * jax.random.normal(key, shape)).at[:, 0].set(0.0)
    return _Regions(start, jnp.clip(start + noise, -1.0, 1.0), jnp.int32(0))


def _propose(config, memory, key):
    return memory.particles.reshape(-1, len(memory.design))


def _update(config, memory, scored, key):
    shape = memory.particles.shape
    values = scored.values.reshape(shape[:2])
    # The next population is scored in the next iteration; none follows the last.
    left = 1.0 - (memory.iteration + 1) / config.iterations
    keys = jax.random.split(key, config.regions)
    move_all = jax.vmap(lambda *region: move(config, left, *region))
    particles = move_all(memory.particles, values, scored.gradients.reshape(shape), keys)
    best = jnp.argmax(scored.values)
    found = jnp.where(scored.values[best] > -jnp.inf, scored.designs[best], memory.design)
    return _Regions(found, particles, memory.iteration + 1)


def move(config, left, particles, values, gradients, key):
    """Resample and perturb the particles [P, d] of one region.

    `left`, from 1 to 0, is the share of the temperature and of the noise that remains. Particles
    whose value [P] is not finite have no children, unless none is finite.
    """
    count, size = particles.shape
    resample_key, noise_key = jax.random.split(key)

    # Weights of the resampling, by value.
    valid = jnp.isfinite(values)
    spread = jnp.std(values, where=valid) + config.epsilon
    advantage = jnp.where(valid, values - jnp.max(values), -jnp.inf) / spread
    weights = jax.nn.softmax(advantage / (config.temperature * left + config.epsilon))
    weights = jnp.where(jnp.any(valid), weights, 1.0 / count)

    # Systematic resampling: equally spaced points on the cumulative weights.
    points = (jax.random.uniform(resample_key) + jnp.arange(count)) / count
    parents = jnp.searchsorted(jnp.cumsum(weights), points).clip(0, count - 1)

    # Noise with the covariance of the weighted gradients, scaled to the size that is left.
    root = jnp.sqrt(weights)[:, None] * gradients  # rootᵀ root = C
    noise = jax.random.normal(noise_key, (count, count)) @ root
    noise *= left * config.step_size / (jnp.sqrt(jnp.sum(root**2) / size) + config.epsilon)

    best = jnp.argmax(values)
    parents, noise = parents.at[0].set(best), noise.at[0].set(0.0)
    return jnp.clip(particles[parents] + noise, -1.0, 1.0)


_STEPS = Steps(_begin, _propose, _update, gradients=True)
