"""All search methods: one contract, known optima, and independent versions of the baselines."""

import dataclasses
import importlib.util
import sys
from functools import partial

import cma
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shapebody.agent.store import load_agent
from shapebody.design.space import DesignSpace
from shapebody.optimizers.ars import ARSConfig, ars
from shapebody.optimizers.cem import CEMConfig, cem
from shapebody.optimizers.cma_es import CMAESConfig, cma_es
from shapebody.optimizers.de import DEConfig, de
from shapebody.optimizers.gc_pfo import GCPFOConfig, move
from shapebody.optimizers.loop import start_key
from shapebody.optimizers.objective import Objective
from shapebody.optimizers.pso import PSOConfig, pso
from shapebody.optimizers.random_search import RandomConfig, random
from shapebody.optimizers.search import METHODS, search
from shapebody.optimizers.turbo import TuRBOConfig, turbo
from shapebody.optimizers.vgds import VGDSConfig
from shapebody.robot.robot import load_robot

SMALL = {
    "vgds": dict(iterations=3),
    "penalty-only": dict(iterations=3),
    "random": dict(iterations=3, candidates=5),
    "bo": dict(iterations=2, initial_points=4, restarts=2, raw_samples=16),
    "cma-es": dict(iterations=3, particles=5),
    "turbo": dict(iterations=3, candidates=5),
    "pso": dict(iterations=3, particles=5),
    "cem": dict(iterations=3, particles=8),
    "de": dict(iterations=3, particles=5),
    "ars": dict(iterations=3, directions=4),
    "gc-pfo": dict(iterations=3, particles=4),
}
"""Settings for tests that ask for the contract and not for the quality."""

NO_BOTORCH = pytest.mark.skipif(
    importlib.util.find_spec("botorch") is None, reason="BoTorch is not installed"
)


def every_method(without=(), slow=()):
    def marks(name):
        return [NO_BOTORCH] * (name == "bo") + [pytest.mark.slow] * (name in slow)

    return pytest.mark.parametrize(
        "name", [pytest.param(name, marks=marks(name)) for name in METHODS if name not in without]
    )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Quadratic:
    """-100/d |f - target|² plus the minibatch, a number that is the same for all designs.

    Not finite where the first parameter is above `wall`.
    """

    target: jax.Array
    noise: float = 0.03
    wall: float = 2.0

    def batch(self, key):
        return self.noise * jax.random.normal(key)

    def penalty(self, designs):
        return 100 * jnp.mean((designs - self.target) ** 2, -1)

    def __call__(self, designs, states):
        values = states - self.penalty(designs)
        return jnp.where(designs[..., 0] > self.wall, -jnp.inf, values)


def run(name, objective, starts, seed=0, **settings):
    method = METHODS[name]
    found = method.function(
        objective, jnp.asarray(starts), jax.random.key(seed), method.config(**settings)
    )
    return found._replace(**{k: np.asarray(getattr(found, k)) for k in found._fields[:3]})


def uniform(*shape, seed=0, limit=1.0):
    return np.random.default_rng(seed).uniform(-limit, limit, shape).astype(np.float32)


pytestmark = pytest.mark.usefixtures("quick")


# every method

# The part of the start's distance² to the optimum that may remain, for the default budget. With
# 50 parameters the gradient methods are done, and 3200 uniform draws hardly come closer.
REMAINS = {
    "vgds": 0.01,
    "penalty-only": 0.01,
    "gc-pfo": 0.001,
    "ars": 0.06,
    "turbo": 0.12,
    "cma-es": 0.15,
    "pso": 0.2,
    "de": 0.25,
    "cem": 0.25,
    "bo": 0.4,
    "random": 0.9,
}


BUDGETS = {
    "vgds": 50,
    "penalty-only": 50,
    "random": 50 * 64,
    "bo": 10 + 50,
    "cma-es": 50 * 15,
    "turbo": 50 * (64 + 1),
    "pso": 50 * 32,
    "cem": 50 * 32,
    "de": 50 * 32,
    "ars": 50 * 2 * 16,
    "gc-pfo": 50 * 2 * 32,
}


@every_method(slow=["bo"])
def test_the_optimum_of_a_quadratic_in_fifty_dimensions(name):
    target = uniform(50, limit=0.7)
    starts = uniform(1 if name == "bo" else 5, 50, seed=1)
    found = run(name, Quadratic(target), starts)
    assert found.evaluations == BUDGETS[name]
    remains = np.sum((found.designs - target) ** 2, -1) / np.sum((starts - target) ** 2, -1)
    assert np.all(remains < REMAINS[name]), remains
    if name != "random":
        assert np.all(found.history[-1] > found.history[0])


@every_method()
def test_contract(name):
    # The corners of the box are designs too.
    starts = np.concatenate([uniform(2, 6), np.sign(uniform(1, 6))])
    found = run(name, Quadratic(uniform(6, seed=1)), starts, **SMALL[name])
    iterations = SMALL[name]["iterations"]
    assert found.designs.shape == (3, 6) and found.designs.dtype == np.float32
    assert found.trajectory.shape == (iterations + 1, 3, 6)
    assert found.history.shape == (iterations + 1, 3) and np.all(np.isfinite(found.history))
    np.testing.assert_array_equal(found.trajectory[0], starts)
    np.testing.assert_array_equal(found.trajectory[-1], found.designs)
    assert np.all(np.abs(found.trajectory) <= 1)
    assert isinstance(found.evaluations, int)


@every_method()
def test_a_search_repeats_and_depends_on_its_seed(name):
    objective, starts = Quadratic(uniform(6, seed=1)), uniform(2, 6)
    one, same, other = (run(name, objective, starts, seed, **SMALL[name]) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.trajectory, same.trajectory)
    np.testing.assert_array_equal(one.history, same.history)
    assert not np.array_equal(one.history, other.history)
    if name not in ("vgds", "penalty-only"):  # the minibatches of a Quadratic have no gradient
        assert not np.array_equal(one.trajectory, other.trajectory)


@every_method()
def test_a_start_does_not_depend_on_its_company(name):
    objective, starts = Quadratic(uniform(6, seed=1)), uniform(3, 6)
    together = run(name, objective, starts, **SMALL[name])
    turned = run(name, objective, starts[::-1], **SMALL[name])
    alone = run(name, objective, starts[1:2], **SMALL[name])
    if name in ("random", "turbo", "pso", "cem", "de", "ars", "gc-pfo"):  # one program per start
        np.testing.assert_array_equal(turned.trajectory[:, ::-1], together.trajectory)
        np.testing.assert_array_equal(alone.trajectory[:, 0], together.trajectory[:, 1])
        np.testing.assert_array_equal(alone.history[:, 0], together.history[:, 1])
    np.testing.assert_allclose(turned.trajectory[:, ::-1], together.trajectory, atol=1e-6)
    np.testing.assert_allclose(alone.trajectory[:, 0], together.trajectory[:, 1], atol=1e-6)
    np.testing.assert_allclose(alone.history[:, 0], together.history[:, 1], atol=1e-5)


def test_starts_have_random_numbers_of_their_own():
    starts = uniform(2, 6)
    found = run("random", Quadratic(uniform(6, seed=1)), starts, **SMALL["random"])
    assert not np.array_equal(found.designs[0], found.designs[1])


@every_method()
def test_designs_without_a_finite_objective_are_not_returned(name):
    # The optimum is behind the wall, the starts before it.
    target = jnp.full(6, 0.7)
    starts = -np.abs(uniform(3, 6))
    settings = SMALL[name] | (dict(iterations=30) if name in ("vgds", "ars") else {})
    found = run(name, Quadratic(target, wall=0.05), starts, **settings)
    assert np.all(found.designs[:, 0] <= 0.05)
    if name == "vgds":
        assert np.all(found.trajectory[-1, :, 0] > 0.05), "the test does not test anything"


@every_method()
def test_an_objective_that_is_never_finite_gives_a_design(name):
    starts = uniform(2, 6)
    found = run(name, Quadratic(jnp.zeros(6), wall=-2.0), starts, **SMALL[name])
    np.testing.assert_array_equal(found.designs, starts)
    assert np.all(np.isfinite(found.trajectory)) and np.all(np.abs(found.trajectory) <= 1)


class Counter:
    rows = 0

    def add(self, rows):
        self.rows += rows


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Counting(Quadratic):
    """A Quadratic that counts the designs it scores."""

    counter: Counter = dataclasses.field(default=None, metadata=dict(static=True))

    def __call__(self, designs, states):
        jax.debug.callback(partial(self.counter.add, int(np.prod(designs.shape[:-1]))))
        return super().__call__(designs, states)


@every_method()
def test_evaluations_are_counted(name):
    counter, iterations = Counter(), SMALL[name]["iterations"]
    found = run(name, Counting(uniform(6), counter=counter), uniform(2, 6), **SMALL[name])
    jax.effects_barrier()
    # Scores of the trajectory that only fill the history do not count.
    history = {"vgds": 1, "penalty-only": 1, "turbo": 1, "bo": iterations}
    assert counter.rows == 2 * (found.evaluations + history.get(name, iterations + 1))


def test_settings_of_the_paper():
    for name in ("vgds", "penalty-only"):
        assert METHODS[name].config() == VGDSConfig(50, 0.05, 0.1)
    assert METHODS["random"].config() == RandomConfig(50, 64)
    assert METHODS["turbo"].config() == TuRBOConfig(50, 64, 0.1, 0.005, 0.5, 0.7, 1.3)
    assert METHODS["pso"].config() == PSOConfig(50, 32, 0.9, 0.5, 0.3)
    assert METHODS["cem"].config() == CEMConfig(50, 32, 0.2, 0.5, 0.02)
    assert METHODS["de"].config() == DEConfig(50, 32, 0.5, 0.9)
    assert METHODS["ars"].config() == ARSConfig(50, 16, 0.1, 0.05, 1.0)
    assert METHODS["gc-pfo"].config() == GCPFOConfig(50, 2, 32, 0.2, 1.0, 1e-8)
    assert METHODS["cma-es"].config() == CMAESConfig(50, 0.5)
    settings = dataclasses.asdict(METHODS["bo"].config())
    steps = settings.pop("steps")
    assert settings == dict(iterations=50, initial_points=10, restarts=8, raw_samples=256)
    assert steps == 50
    assert CEMConfig().elites == 6 and CMAESConfig().population(358) == 21


@pytest.mark.parametrize(
    "name, bad",
    [
        *(
            (name, dict(iterations=value))
            for name in METHODS
            for value in (0, 2.5, 2.0, "ten", True)
        ),
        ("turbo", dict(iterations=float("nan"))),
        ("random", dict(candidates=0)),
        ("turbo", dict(radius=0.6)),
        ("turbo", dict(minimum_radius=0.6)),
        ("turbo", dict(shrink=0.0)),
        ("turbo", dict(expand=0.9)),
        ("pso", dict(inertia=-0.1)),
        ("pso", dict(initial_std=0.0)),
        ("cem", dict(elite_fraction=0.0)),
        ("cem", dict(minimum_std=float("nan"))),
        ("de", dict(particles=3)),
        ("de", dict(crossover=1.1)),
        ("de", dict(weight=-1.0)),
        ("ars", dict(directions=0)),
        ("ars", dict(top_fraction=1.5)),
        ("ars", dict(perturbation_std=0.0)),
        ("gc-pfo", dict(regions=0)),
        ("gc-pfo", dict(particles=1)),
        ("gc-pfo", dict(step_size=float("inf"))),
        ("cma-es", dict(initial_std=0.0)),
        ("cma-es", dict(particles=1)),
        ("bo", dict(initial_points=1)),
        ("bo", dict(steps=0)),
    ],
)
def test_bad_settings_are_named(name, bad):
    setting = next(iter(bad))
    with pytest.raises(ValueError, match=f"{setting} is .*; expected"):
        METHODS[name].config(**bad)


# independent versions, given the same random numbers


def draws(key, start, iterations):
    """Keys of one start: of its beginning, and a pair for every iteration."""
    first, *rest = jax.random.split(start_key(key, start), iterations + 1)
    return first, [jax.random.split(key) for key in rest]


def noises(objective, key, iterations):
    return [float(objective.batch(k)) for k in jax.random.split(key, iterations + 1)]


def check(method, config, reference, atol=1e-4):
    """Compare the trajectory with that of `reference(config, start, value, first, keys)`."""
    target, starts, key = uniform(7, seed=5, limit=0.6), uniform(3, 7, seed=6), jax.random.key(11)
    objective = Quadratic(jnp.asarray(target), noise=1.0)
    found = method(objective, jnp.asarray(starts), key, config)
    noise = noises(objective, key, config.iterations)

    def value(f, n):
        return noise[n] - 100 * np.mean((np.asarray(f, np.float64) - target) ** 2)

    for index, start in enumerate(starts):
        first, keys = draws(key, start, config.iterations)
        expected = reference(config, np.float64(start), value, first, keys)
        np.testing.assert_allclose(found.trajectory[1:, index], expected, atol=atol)
        scores = [value(f, n) for n, f in enumerate([start, *expected])]
        np.testing.assert_allclose(found.history[:, index], scores, atol=1e-2)


def normal(key, *shape):
    return np.asarray(jax.random.normal(key, shape), np.float64)


def flat(key, *shape, low=0.0):
    return np.asarray(jax.random.uniform(key, shape, minval=low), np.float64)


def clip(f):
    return np.minimum(1, np.maximum(-1, f))


def random_reference(config, start, value, first, keys):
    best, score, rows = start, -np.inf, []
    for n, (key, _) in enumerate(keys):
        for f in flat(key, config.candidates, len(start), low=-1.0):
            if value(f, n) > score:
                best, score = f, value(f, n)
        rows.append(best)
    return rows


def turbo_reference(config, start, value, first, keys):
    centre, radius, rows = start, config.radius, []
    for n, (key, _) in enumerate(keys):
        offsets = flat(key, config.candidates, len(start), low=-1.0)
        best = max((clip(centre + radius * o) for o in offsets), key=lambda f: value(f, n))
        if value(best, n) > value(centre, n):
            centre, radius = best, min(radius * config.expand, config.maximum_radius)
        else:
            radius = max(radius * config.shrink, config.minimum_radius)
        rows.append(centre)
    return rows


def pso_reference(config, start, value, first, keys):
    x = flat(first, config.particles, len(start), low=-1.0)
    x[0] = start
    v, best, scores, rows = 0 * x, x.copy(), [-np.inf] * len(x), []
    for n, (_, key) in enumerate(keys):
        r = flat(key, 2, *x.shape)
        for i in range(len(x)):
            if value(x[i], n) > scores[i]:
                best[i], scores[i] = x[i], value(x[i], n)
        leader = best[int(np.argmax(scores))].copy()
        for i in range(len(x)):
            pull = config.cognitive * r[0, i] * (best[i] - x[i])
            pull += config.social * r[1, i] * (leader - x[i])
            old, x[i] = x[i].copy(), clip(x[i] + config.inertia * v[i] + pull)
            v[i] = x[i] - old
        rows.append(leader)
    return rows


def cem_reference(config, start, value, first, keys):
    mean, std, rows = start, np.full_like(start, config.initial_std), []
    for n, (key, _) in enumerate(keys):
        samples = clip(mean + std * normal(key, config.particles, len(start)))
        best = sorted(samples, key=lambda f: -value(f, n))[: int(0.2 * config.particles)]
        mean = np.mean(best, axis=0)
        std = np.maximum(np.std(best, axis=0), config.minimum_std)
        rows.append(mean)
    return rows


def de_reference(config, start, value, first, keys):
    x = np.clip(start + config.initial_std * normal(first, config.particles, len(start)), -1, 1)
    x[0] = start
    scores, rows = [value(f, 0) for f in x], []
    rows.append(x[int(np.argmax(scores))].copy())
    for n, (key, _) in list(enumerate(keys))[1:]:
        trials = []
        for i, own in enumerate(jax.random.split(key, len(x))):
            others_key, cross_key, forced_key = jax.random.split(own, 3)
            rest = [j for j in range(len(x)) if j != i]
            others = jax.random.choice(others_key, len(rest), (3,), replace=False)
            a, b, c = (x[rest[j]] for j in np.asarray(others))
            crossed = flat(cross_key, len(start)) < config.crossover
            crossed[int(jax.random.randint(forced_key, (), 0, len(start)))] = True
            trials.append(np.where(crossed, clip(a + config.weight * (b - c)), x[i]))
        for i, trial in enumerate(trials):
            if value(trial, n) > scores[i]:
                x[i], scores[i] = trial, value(trial, n)
        rows.append(x[int(np.argmax(scores))].copy())
    return rows


def ars_reference(config, start, value, first, keys):
    f, rows = start, []
    delta_keys = [first, *(key for _, key in keys)]
    for n, key in enumerate(delta_keys[:-1]):
        tried = []
        for delta in normal(key, config.directions, len(start)):
            plus = value(clip(f + config.perturbation_std * delta), n)
            minus = value(clip(f - config.perturbation_std * delta), n)
            tried.append((max(plus, minus), plus, minus, delta))
        tried.sort(key=lambda t: -t[0])
        tried = tried[: round(config.top_fraction * config.directions)]
        sigma = np.std([t[1] for t in tried] + [t[2] for t in tried])
        step = sum((plus - minus) * delta for _, plus, minus, delta in tried)
        f = clip(f + config.learning_rate / (len(tried) * sigma) * step)
        rows.append(f)
    return rows


@pytest.mark.parametrize(
    "method, config, reference",
    [
        (random, RandomConfig(6, 5), random_reference),
        (turbo, TuRBOConfig(12, 4, maximum_radius=0.15, minimum_radius=0.05), turbo_reference),
        (pso, PSOConfig(10, 6), pso_reference),
        (cem, CEMConfig(10, 20), cem_reference),
        (de, DEConfig(10, 7, initial_std=0.6), de_reference),
        (ars, ARSConfig(10, 6, learning_rate=0.2), ars_reference),
        (ars, ARSConfig(10, 6, learning_rate=0.2, top_fraction=0.5), ars_reference),
    ],
)
def test_against_an_independent_version(method, config, reference):
    check(method, config, reference)


def test_cma_es_is_the_librarys():
    target, starts, key = uniform(9, seed=5), uniform(2, 9, seed=6), jax.random.key(11)
    found = cma_es(Quadratic(jnp.asarray(target), noise=0.0), starts, key, CMAESConfig(30))
    for index, start in enumerate(starts):
        numbers = np.random.default_rng(np.asarray(jax.random.key_data(start_key(key, start))))
        options = cma.CMAOptions()
        options.set("bounds", [-1, 1])
        options.set("CMA_diagonal", True)
        options.set("randn", lambda *shape, numbers=numbers: numbers.standard_normal(shape))
        options.set("seed", np.nan)
        options.set("verbose", -9)
        strategy = cma.CMAEvolutionStrategy(np.float64(start), 0.5, options)
        assert strategy.popsize == CMAESConfig().population(9)
        strategy.optimize(lambda f: float(np.mean((f - target) ** 2)), iterations=30)
        np.testing.assert_allclose(found.designs[index], strategy.result.xfavorite, atol=1e-4)


def test_cma_es_leaves_the_global_random_state_alone():
    np.random.seed(4)
    expected = np.random.RandomState(4).rand(3)
    run("cma-es", Quadratic(jnp.zeros(4)), uniform(1, 4), **SMALL["cma-es"])
    np.testing.assert_array_equal(np.random.rand(3), expected)


# GC-PFO


def test_gc_pfo_explores_along_the_gradients():
    config, size = GCPFOConfig(particles=400), 5
    particles = jnp.zeros((400, size))
    gradients = jnp.tile(jnp.array([3.0, -4.0, 0, 0, 0]), (400, 1))
    moved = np.asarray(move(config, 1.0, particles, jnp.zeros(400), gradients, jax.random.key(0)))
    # All gradients are parallel, so all noise is too, to both sides, with the given size.
    np.testing.assert_allclose(moved[:, 2:], 0, atol=1e-6)
    inside = np.abs(moved).max(1) < 1
    np.testing.assert_allclose(moved[inside, 0] / 3, moved[inside, 1] / -4, atol=1e-6)
    assert 0.4 < np.mean(moved[1:, 0] > 0) < 0.6
    assert np.sqrt(np.mean(moved**2)) == pytest.approx(config.step_size, rel=0.1)
    np.testing.assert_array_equal(moved[0], 0)


def test_gc_pfo_noise_has_the_covariance_of_the_gradients():
    config, count = GCPFOConfig(particles=4000, step_size=0.05), 4000
    rng = np.random.default_rng(0)
    gradients = rng.normal(size=(count, 3)) @ np.array([[1, 0.5, 0], [0, 0.7, 0], [0, 0, 0.2]])
    moved = move(
        config,
        1.0,
        jnp.zeros((count, 3)),
        jnp.zeros(count),
        jnp.float32(gradients),
        jax.random.key(1),
    )
    covariance, expected = np.cov(np.asarray(moved).T), gradients.T @ gradients
    np.testing.assert_allclose(
        covariance / np.trace(covariance), expected / np.trace(expected), atol=0.03
    )


def test_gc_pfo_resamples_by_value():
    particles = jnp.linspace(-0.9, 0.9, 50)[:, None]
    values = -((particles[:, 0] - 0.3) ** 2)
    values = values.at[:5].set(-jnp.inf)
    still = jnp.zeros_like(particles)
    spread = []
    for left in (1.0, 0.1, 0.0):
        chosen = move(GCPFOConfig(), left, particles, values, still, jax.random.key(0))
        assert np.all(chosen > particles[4]), "a particle without a value survived"
        spread.append(float(jnp.std(chosen)))
    assert spread[0] > spread[1] > spread[2] == 0
    assert chosen[0, 0] == particles[jnp.argmax(values), 0]


# Bayesian optimization


def test_without_botorch_the_error_names_the_fix(monkeypatch):
    monkeypatch.setitem(sys.modules, "botorch", None)
    with pytest.raises(ImportError, match=r"pip install -e '\.\[bo\]'"):
        run("bo", Quadratic(jnp.zeros(4)), uniform(1, 4))


@NO_BOTORCH
@pytest.mark.parametrize("starts", [1, 3])  # in this process, and in several
def test_bo_leaves_pytorch_as_it_was(starts):
    import torch

    threads, state = torch.get_num_threads(), torch.get_rng_state()
    run("bo", Quadratic(jnp.zeros(4)), uniform(starts, 4), **SMALL["bo"])
    assert torch.get_num_threads() == threads
    assert torch.equal(torch.get_rng_state(), state)


@NO_BOTORCH
def test_bo_begins_with_the_start_and_sobol_points():
    from shapebody.optimizers.bayesian import BOConfig, _Surrogate

    start = uniform(5)
    points = _Surrogate(start, jax.random.key(0), BOConfig(initial_points=9)).initial()
    np.testing.assert_array_equal(points[0], start)
    # Eight Sobol points have one in every eighth of every parameter's range.
    eighths = np.sort(np.floor((points[1:] + 1) * 4).astype(int), axis=0)
    np.testing.assert_array_equal(eighths, np.tile(np.arange(8)[:, None], (1, 5)))


# with critics


@every_method(without=["vgds", "penalty-only"])
def test_search_with_a_critic(name, agent, robot):
    space = DesignSpace(robot)
    starts = np.stack([space.start(i) for i in range(2)])
    settings = dict(batch_size=8) | SMALL[name]
    found = search(name, agent, robot, starts, **settings)
    iterations = settings["iterations"]
    assert found.trajectory.shape == (iterations + 1, *starts.shape)
    assert found.settings["iterations"] == iterations and found.method == name
    np.testing.assert_allclose(found.objective, Objective.of(agent, robot)(found.design), atol=1e-4)
    # Another penalty, seed or critic needs no compilation.
    other = dataclasses.replace(agent, critic=jax.tree.map(lambda x: 0.5 * x, agent.critic))
    changed = search(name, other, robot, starts, seed=1, trust_region=3, **settings)
    assert changed.compile_seconds == 0


@pytest.mark.parametrize("name", ["cem", "cma-es"])
def test_batch_equals_single_to_the_last_bit(name, agent, robot):
    space = DesignSpace(robot)
    starts = np.stack([space.start(i) for i in range(2)])
    settings = dict(batch_size=8) | SMALL[name]
    batch = search(name, agent, robot, starts, **settings)
    single = search(name, agent, robot, starts[1], **settings)
    assert single.design.shape == (space.dim,) and isinstance(single.objective, float)
    np.testing.assert_array_equal(single.trajectory, batch.trajectory[:, 1])


def check_large(agent, robot, name, **settings):
    space = DesignSpace(robot)
    starts = np.stack([space.start(i) for i in range(2)])
    found = search(name, agent, robot, starts, **settings)
    space.validate(found.design)
    if name != "random":
        assert np.all(found.objective > np.asarray(Objective.of(agent, robot)(starts)))


@pytest.mark.slow
@every_method(without=["vgds", "penalty-only"])
def test_the_shipped_agent(name):
    settings = {"bo": dict(restarts=2, raw_samples=32), "de": dict(initial_std=0.5)}
    settings = dict(iterations=6) | settings.get(name, {})
    check_large(load_agent("unitree_go2"), load_robot("unitree_go2"), name, **settings)


@pytest.mark.slow
@pytest.mark.parametrize(
    "body, name",
    [
        *(("mit_humanoid", name) for name in ("vgds", "cma-es", "turbo", "gc-pfo")),
        *(("golem", name) for name in ("random", "pso", "cem", "de", "ars")),
    ],
)
def test_larger_robots(name, body):
    settings = {"de": dict(initial_std=0.5)}.get(name, {})
    check_large(load_agent(body), load_robot(body), name, batch_size=8, **settings)
