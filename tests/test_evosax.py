"""ARS, DE and PSO against the library evosax, which is not in the lock (extra `cross-check`)."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from test_baselines import Quadratic, draws

from shapebody.optimizers.ars import ARSConfig, ars
from shapebody.optimizers.de import DEConfig, de
from shapebody.optimizers.pso import PSOConfig, pso

evosax = pytest.importorskip("evosax", reason="evosax is not installed")
algorithms = pytest.importorskip("evosax.algorithms")

RUNS = 64


pytestmark = pytest.mark.usefixtures("quick")


def quadratic(size):
    target = np.random.default_rng(5).uniform(-0.5, 0.5, size).astype(np.float32)
    return Quadratic(jnp.asarray(target), noise=0.0)


def loss(objective, designs):
    return objective.penalty(designs)


def test_ars_takes_the_librarys_steps():
    objective, key = quadratic(7), jax.random.key(3)
    config = ARSConfig(iterations=20)
    start = np.random.default_rng(6).uniform(-0.5, 0.5, 7).astype(np.float32)
    ours = ars(objective, jnp.asarray(start[None]), key, config).trajectory[1:, 0]

    std = optax.constant_schedule(config.perturbation_std)
    library = algorithms.ARS(
        2 * config.directions, jnp.asarray(start), optax.sgd(config.learning_rate), std
    )
    library.elite_ratio = config.top_fraction
    params = library.default_params
    state = library.init(key, jnp.asarray(start), params)
    first, pairs = draws(key, start, config.iterations)
    theirs = []
    for direction_key in [first, *(second for _, second in pairs)][: config.iterations]:
        population, state = library.ask(direction_key, state, params)
        state, _ = library.tell(key, population, loss(objective, population), state, params)
        theirs.append(state.mean)
    # Nothing was clipped, which the library does not do.
    assert np.abs(ours).max() < 1
    np.testing.assert_allclose(ours, theirs, atol=1e-4)


def our_losses(method, config, objective, size):
    """Loss of the found design, from one start that is like the rest of the population."""

    def one(key):
        start = jax.random.uniform(key, (size,), minval=-1.0, maxval=1.0)
        return np.asarray(method(objective, start[None], key, config).designs[0])

    return np.array([loss(objective, one(jax.random.key(seed))) for seed in range(RUNS)])


def their_losses(library, params, objective, size, iterations):
    """The same with the library, whose trials are clipped to the box as ours are."""

    @jax.jit
    def one(key):
        keys = jax.random.split(key, iterations)
        shape = (library.population_size, size)
        population = jax.random.uniform(keys[0], shape, minval=-1.0, maxval=1.0)
        state = library.init(keys[0], population, loss(objective, population), params)
        # evosax leaves it to the first generation to score the initial population.
        state, _ = library.tell(keys[0], population, loss(objective, population), state, params)
        best = jnp.min(loss(objective, population))
        for key in keys[1:]:
            trials, following = library.ask(key, state, params)
            trials = jnp.clip(trials, -1.0, 1.0)
            if hasattr(state, "velocity"):
                following = following.replace(velocity=trials - state.population)
            losses = loss(objective, trials)
            state, _ = library.tell(key, trials, losses, following, params)
            best = jnp.minimum(best, jnp.min(losses))
        return best

    return np.array([one(jax.random.key(1000 + seed)) for seed in range(RUNS)])


def apart(ours, theirs):
    """Difference of mean log losses, in standard errors."""
    a, b = np.log10(ours), np.log10(theirs)
    return abs(a.mean() - b.mean()) / np.sqrt((a.var() + b.var()) / RUNS)


def test_de_gets_as_far_as_the_librarys():
    objective, config = quadratic(4), DEConfig(iterations=15)
    library = algorithms.DifferentialEvolution(config.particles, jnp.zeros(4))

    def theirs(weight):
        params = library.default_params.replace(
            elitism=False,
            crossover_rate=config.crossover,
            differential_weight=weight,
            differential_weight_min=weight,
            differential_weight_max=weight,
        )
        return their_losses(library, params, objective, 4, config.iterations)

    ours = our_losses(de, config, objective, 4)
    assert apart(ours, theirs(config.weight)) < 4
    assert apart(ours, theirs(0.9)) > 6  # so the test would notice a wrong setting


def test_pso_gets_as_far_as_the_librarys():
    # In one dimension, since evosax shares its random numbers between parameters.
    objective, config = quadratic(1), PSOConfig(iterations=25, particles=6)
    library = algorithms.PSO(config.particles, jnp.zeros(1))

    def theirs(social):
        params = library.default_params.replace(
            inertia_coeff=config.inertia, cognitive_coeff=config.cognitive, social_coeff=social
        )
        return their_losses(library, params, objective, 1, config.iterations)

    ours = our_losses(pso, config, objective, 1)
    assert apart(ours, theirs(config.social)) < 4
    assert apart(ours, theirs(0.0)) > 6
