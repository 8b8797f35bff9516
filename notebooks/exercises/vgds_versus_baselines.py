"""Exercises of 09_vgds_versus_baselines."""

from collections import namedtuple
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

from exercises import checker, need, same
from shapebody.optimizers.cem import CEMConfig
from shapebody.optimizers.loop import Scored


@checker
def check_cem_generation(function):
    """The next Gaussian of CEM, (mean [d], deviations [d]), from (designs, scores, config)."""
    rng = np.random.default_rng(0)
    for config, spread in ((CEMConfig(), 0.4), (CEMConfig(minimum_std=0.1), 0.01)):
        designs = rng.normal(0.2, spread, (config.particles, 6))
        scores = rng.normal(size=config.particles)
        elites = designs[np.argsort(scores)[-config.elites :]]
        mean, std = function(designs, scores, config) or (None, None)
        need(same(mean, elites.mean(0)), f"Take the mean of the {config.elites} best designs.")
        hint = "It is the deviation of each parameter over the elites, at least minimum_std."
        need(same(std, np.maximum(elites.std(0), config.minimum_std)), hint)
    return "The search method does the same in every generation."


@checker
def check_climb(propose, update):
    """Hill climbing on a quadratic, by two functions as in `shapebody.optimizers.loop.Steps`."""
    config, Memory = SimpleNamespace(particles=16, std=0.12), namedtuple("Memory", "design")
    optimum = jax.random.uniform(jax.random.key(1), (10,), minval=-0.7, maxval=0.7)

    def height(f):
        return -jnp.sum((f - optimum) ** 2, -1)

    @jax.jit
    def iterate(memory, key):
        designs = propose(config, memory, key)
        need(designs is not None and designs.shape == (16, 10), "Propose an array [particles, d].")
        scored = Scored(designs, height(designs), None, height(memory.design))
        return designs, update(config, memory, scored, key)

    memory = Memory(jnp.ones(10))
    for key in jax.random.split(jax.random.key(0), 150):
        before = memory.design
        designs, memory = iterate(memory, key)
        need(memory is not None, "update returns None so far.")
        need(np.abs(designs).max() <= 1, "A proposal leaves the box [-1, 1]; clip it.")
        best = designs[height(designs).argmax()]
        hint = "Move to the best proposal if it is better than scored.current, else stay."
        target = best if height(best) > height(before) else before
        need(same(memory.design, target, 1e-5), hint)
    left = height(memory.design) / height(jnp.ones(10))
    need(left < 0.1, f"After 150 iterations {left:.0%} of the squared distance remain.")
    return f"It stops within {left:.1%} of the first squared distance to the optimum."
