"""The design objective and VGDS."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny import tiny_agent, tiny_robot

from shapebody.design.descriptions import describe
from shapebody.design.space import DesignSpace
from shapebody.evaluation.evaluate import evaluate
from shapebody.evaluation.recording import record_episode
from shapebody.optimizers import objective as optimizers_objective
from shapebody.optimizers import state_bank
from shapebody.optimizers.objective import Objective
from shapebody.optimizers.search import search
from shapebody.optimizers.vgds import VGDSConfig, penalty_only, vgds
from shapebody.reproduction.design_study import design_study
from shapebody.task.env import Locomotion

BATCH = dict(batch_size=8)
"""One size of minibatches for all searches here, so that few programs are compiled."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Quadratic:
    """-|f - target - noise|² with noise as the minibatch, in place of a real objective."""

    target: jax.Array
    noise: float

    def batch(self, key):
        return self.noise * jax.random.normal(key, self.target.shape)

    def penalty(self, designs):
        return 3 * jnp.sum((designs - 0.25) ** 2, -1)

    def __call__(self, designs, states):
        return -jnp.sum((designs - self.target - states) ** 2, -1)


def adam_reference(gradient, f, steps, rate=0.05, limit=0.1):
    """Adam ascent with both clips, as written in the paper; rows are iterates."""
    m, v, rows = np.zeros_like(f), np.zeros_like(f), [f]
    for n in range(1, steps + 1):
        g = gradient(rows[-1], n - 1)
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g * g
        step = rate * (m / (1 - 0.9**n)) / (np.sqrt(v / (1 - 0.999**n)) + 1e-8)
        rows.append(np.clip(rows[-1] + np.clip(step, -limit, limit), -1, 1))
    return np.stack(rows)


pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture(scope="module")
def space(robot):
    return DesignSpace(robot)


@pytest.fixture(scope="module")
def starts(space):
    return np.stack([space.start(i) for i in range(3)])


# VGDS


def test_vgds_finds_the_optimum_of_a_quadratic():
    target = jnp.linspace(-0.8, 0.8, 7)
    starts = jax.random.uniform(jax.random.key(1), (4, 7), minval=-1, maxval=1)
    found = vgds(Quadratic(target, 0.0), starts, jax.random.key(0), VGDSConfig(iterations=300))
    np.testing.assert_allclose(found.designs, jnp.broadcast_to(target, (4, 7)), atol=1e-3)
    assert found.trajectory.shape == (301, 4, 7) and found.history.shape == (301, 4)
    assert found.evaluations == 300
    np.testing.assert_array_equal(found.trajectory[0], starts)
    np.testing.assert_array_equal(found.trajectory[-1], found.designs)
    assert np.all(found.history[-1] > -1e-5)


def test_an_optimum_outside_the_box_ends_on_its_face():
    target = jnp.array([3.0, -3.0, 0.5])
    found = vgds(Quadratic(target, 0.0), jnp.zeros((1, 3)), jax.random.key(0), VGDSConfig(60, 0.1))
    np.testing.assert_allclose(found.designs[0, :2], [1, -1])


@pytest.mark.parametrize("limit", [0.1, 0.03])
def test_vgds_equals_plain_adam(limit):
    target, steps, key = np.linspace(-1.2, 0.9, 5), 40, jax.random.key(7)
    objective = Quadratic(jnp.asarray(target, jnp.float32), 0.1)
    starts = np.random.default_rng(0).uniform(-1, 1, (2, 5))
    config = VGDSConfig(iterations=steps, max_update=limit)
    found = vgds(objective, jnp.asarray(starts, jnp.float32), key, config)
    keys = jax.random.split(key, steps + 1)
    noise = np.array([objective.batch(k) for k in keys], np.float64)
    for i, start in enumerate(starts):
        expected = adam_reference(
            lambda f, n: -2 * (f - target - noise[n]), start, steps, limit=limit
        )
        np.testing.assert_allclose(found.trajectory[:, i], expected, atol=2e-5)
        scores = -np.sum((expected - target - noise) ** 2, -1)
        np.testing.assert_allclose(found.history[:, i], scores, atol=1e-3)


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 2**31 - 1),
    target=st.floats(-1e6, 1e6),
    rate_and_limit=st.sampled_from([(0.05, 0.1), (10.0, 0.3)]),
)
def test_updates_and_box_are_respected(seed, target, rate_and_limit):
    rate, limit = rate_and_limit
    starts = jax.random.uniform(jax.random.key(seed), (2, 4), minval=-1, maxval=1)
    objective = Quadratic(jnp.full(4, target), 1.0)
    for method in (vgds, penalty_only):
        found = method(objective, starts, jax.random.key(seed), VGDSConfig(5, rate, limit))
        assert np.all(np.abs(found.trajectory) <= 1)
        assert np.all(np.abs(np.diff(found.trajectory, axis=0)) <= limit + 1e-6)


def test_penalty_only_is_adam_on_the_penalty(agent, robot, space, starts):
    reference = 0.5 * space.start(9)
    found = search(
        "penalty-only", agent, robot, starts, **BATCH, trust_region=30.0, reference=reference
    )
    slope = -2 * 30.0 / space.dim
    expected = adam_reference(lambda f, n: slope * (f - reference), starts.astype(np.float64), 50)
    np.testing.assert_allclose(found.trajectory, expected, atol=1e-4)


def test_penalty_only_ignores_the_critic(agent, robot, starts):
    other = dataclasses.replace(agent, critic=jax.tree.map(lambda x: 2 * x + 1, agent.critic))
    one, two = (search("penalty-only", a, robot, starts, **BATCH) for a in (agent, other))
    np.testing.assert_array_equal(one.trajectory, two.trajectory)
    assert not np.allclose(one.history, two.history)
    assert not np.allclose(search("vgds", other, robot, starts, **BATCH).design, one.design)


def test_names_and_broken_seeds_are_no_arguments(agent, robot):
    with pytest.raises(TypeError, match=r"expected a Robot: load it with shapebody.load_robot"):
        search("vgds", agent, robot.name, DesignSpace(robot).reference)
    for function in (
        lambda: search("vgds", "unitree_go2", robot, DesignSpace(robot).reference),
        lambda: Objective.of("unitree_go2", robot),
        lambda: evaluate("unitree_go2", robot, DesignSpace(robot).reference),
        lambda: record_episode("unitree_go2", robot),
        lambda: design_study("unitree_go2", robot),
    ):
        with pytest.raises(TypeError, match="agent is 'unitree_go2'; expected an Agent: load it"):
            function()
    with pytest.raises(ValueError, match="seed is 1.5; expected an integer of at least 0"):
        search("vgds", agent, robot, DesignSpace(robot).reference, seed=1.5)
    with pytest.raises(TypeError, match="expected a Robot"):
        DesignSpace("unitree_go2")
    with pytest.raises(TypeError, match="expected a Robot"):
        Locomotion("unitree_go2", num_envs=2)
    with pytest.raises(ValueError, match="start design is None; expected an integer"):
        DesignSpace(robot).start(None)


@pytest.mark.parametrize("bad", [{"iterations": 0}, {"learning_rate": 0.0}, {"max_update": -1.0}])
def test_bad_settings_are_named(bad):
    with pytest.raises(ValueError, match=f"{next(iter(bad))} is"):
        VGDSConfig(**bad)


# the objective


def test_objective_is_the_mean_over_states_and_heads_minus_the_penalty(agent, robot, space):
    reference = 0.3 * space.start(5)
    objective = Objective.of(agent, robot, trust_region=7.0, reference=reference)
    f = space.start(2)
    descriptions = jax.jit(describe(robot))(space(f))
    values = [
        np.mean(agent.values(descriptions, jax.tree.map(lambda x, m=m: x[m], agent.states)))
        for m in range(agent.num_states)
    ]
    expected = np.mean(values) - 7.0 * np.mean((f - reference) ** 2)
    assert float(objective(f)) == pytest.approx(expected, abs=1e-5)
    assert float(objective.value(f)) == pytest.approx(np.mean(values), abs=1e-5)


def test_slices_of_the_bank_give_the_same_mean(agent, robot, starts, monkeypatch):
    objective = Objective.of(agent, robot)
    whole = np.asarray(objective(starts))
    monkeypatch.setattr(optimizers_objective, "MAX_ROWS", 3 * 7)
    optimizers_objective.mean_value.clear_cache()
    np.testing.assert_allclose(objective(starts), whole, atol=1e-5)
    optimizers_objective.mean_value.clear_cache()


def test_gradient_against_finite_differences(agent, robot, space):
    critic = agent.critic | {"params": jax.tree.map(lambda x: 2 * x, agent.critic["params"])}
    agent = dataclasses.replace(agent, critic=critic)
    objective = Objective.of(agent, robot, trust_region=2.0)

    @jax.jit
    def values_and_gradients(designs):
        def total(designs):
            values = objective(designs, objective.states)
            return jnp.sum(values), values

        return jax.value_and_grad(total, has_aux=True)(designs)

    f, h = 0.5 * space.start(3), 2e-3
    _, gradients = values_and_gradients(np.tile(f, (14, 1)))
    gradient = np.asarray(gradients[0])
    # Random directions, and the gradient itself, in which the value changes fastest.
    directions = np.random.default_rng(0).normal(size=(7, space.dim))
    directions[-1] = gradient
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    (_, values), _ = values_and_gradients(f + h * np.concatenate([directions, -directions]))
    values = np.asarray(values, np.float64)
    slopes = (values[:7] - values[7:]) / (2 * h)
    np.testing.assert_allclose(directions @ gradient, slopes, rtol=0.02, atol=2e-3)
    assert np.linalg.norm(gradient + 4 * f / space.dim) > 0.1, "the value has no gradient"


def test_minibatches(agent, robot):
    objective = Objective.of(agent, robot, batch_size=10)
    one, same, other = (objective.batch(jax.random.key(seed)) for seed in (0, 0, 1))
    assert one.general.shape == (10, 13)
    assert len(np.unique(one.general[:, 0])) == 10
    np.testing.assert_array_equal(one.general, same.general)
    assert not np.array_equal(one.general, other.general)
    # All parts of a drawn state belong together.
    row = np.flatnonzero(agent.states.general[:, 0] == float(one.general[3, 0]))[0]
    np.testing.assert_array_equal(one.joints[3], agent.states.joints[row])
    assert Objective.of(agent, robot).batch(jax.random.key(0)).general.shape == (24, 13)


def test_values_that_are_not_finite_count_as_the_worst(agent, robot, starts):
    broken = dataclasses.replace(agent, critic=jax.tree.map(lambda x: x * np.nan, agent.critic))
    objective = Objective.of(broken, robot)
    assert np.all(np.asarray(objective(starts)) == -np.inf)
    found = search("vgds", broken, robot, starts, **BATCH)
    assert np.isfinite(found.design).all() and np.all(found.objective == -np.inf)


def test_bank_of_known_and_unknown_robots(robot, tmp_path):
    three, four = tiny_robot(tmp_path, 3), tiny_robot(tmp_path, 4)
    both = tiny_agent(robot, four)
    states = state_bank.bank(both, robot)
    np.testing.assert_array_equal(states.general, both.states.general[both.state_robots == 0])
    assert states.joints.shape == (24, 2, 4) and states.feet.shape == (24, 2, 3)
    # A robot of three legs can borrow from the one with four only.
    borrowed = state_bank.bank(both, three)
    np.testing.assert_array_equal(borrowed.general, both.states.general[both.state_robots == 1])
    assert borrowed.joints.shape == (24, 3, 4)
    with pytest.raises(ValueError, match="3 joints and 3 feet of robot 'legs_3'.*states="):
        state_bank.bank(tiny_agent(robot), three)
    with pytest.raises(ValueError, match="no state bank.*states="):
        state_bank.bank(dataclasses.replace(both, states=None), three)


# search


def test_search_improves_and_reports(agent, robot, starts):
    found = search("vgds", agent, robot, starts, **BATCH, trust_region=0.1, seed=3)
    assert found.design.shape == starts.shape and found.trajectory.shape == (51, *starts.shape)
    assert found.history.shape == (51, 3) and found.evaluations == 50
    assert found.design.dtype == np.float32 and found.method == "vgds"
    before = np.asarray(Objective.of(agent, robot, 0.1)(starts))
    assert np.all(found.objective > before)
    assert found.settings["trust_region"] == 0.1 and found.settings["iterations"] == 50
    assert found.settings["agent_hash"] == agent.hash and found.settings["seed"] == 3
    assert found.settings["reference"] is None
    assert found.settings["states_hash"] == agent.states_hash


@pytest.mark.parametrize("method", ["vgds", "penalty-only", "cem", "random"])
def test_frozen_parameters_stay_at_the_reference(agent, robot, space, starts, method):
    names = ("size", "Torque limit")
    held = space.frozen(names)
    assert held.sum() == 3 + robot.num_actuators and held[:3].all()
    reference = 0.5 * space.start(7)
    where = dict(reference=reference, frozen=names)
    found = search(method, agent, robot, starts, **BATCH, **where, iterations=4)
    for designs in (found.design, found.trajectory):
        np.testing.assert_array_equal(
            designs[..., held], np.broadcast_to(reference[held], (*designs.shape[:-1], held.sum()))
        )
    assert np.all(np.abs(found.trajectory[-1] - found.trajectory[0])[:, ~held].max(1) > 0)
    assert found.settings["frozen"] == names
    # The objective is blind for them, and knows the free ones as before.
    objective = Objective.of(agent, robot, **where)
    everything = Objective.of(agent, robot, reference=reference)
    inside = np.where(held, reference, starts)
    np.testing.assert_allclose(objective(starts), everything(inside), rtol=1e-5)
    np.testing.assert_allclose(found.objective, everything(found.design), rtol=1e-5)
    slope = jax.grad(lambda f: jnp.sum(objective(f)))(jnp.asarray(starts))
    assert not np.any(slope[:, held]) and np.any(slope[:, ~held])


def test_unknown_parameters_cannot_be_frozen(agent, robot, space):
    assert not space.frozen(()).any()
    np.testing.assert_array_equal(space.frozen("size"), space.frozen(("size",)))
    with pytest.raises(
        ValueError, match="no parameters 'weight' of robot 'legs_2' .*size, coupled_mass"
    ):
        search("vgds", agent, robot, space.reference, frozen=("weight",))


def test_settings_tell_references_and_states_apart(agent, robot, space, starts):
    def settings(**changes):
        return search("vgds", agent, robot, starts, **BATCH, **changes).settings

    half, again, third = (settings(reference=f * space.start(1)) for f in (0.5, 0.5, 0.3))
    assert half["reference"] == again["reference"] != third["reference"]
    assert len(half["reference"]) == 16 and half["states_hash"] == agent.states_hash
    other = settings(states=jax.tree.map(lambda x: x[::-1], agent.states))
    assert other["reference"] is None and other["states_hash"] != agent.states_hash
    assert settings(states=agent.states)["states_hash"] == agent.states_hash


def test_batch_equals_single(agent, robot, starts):
    batch = search("vgds", agent, robot, starts, **BATCH, seed=1)
    single = search("vgds", agent, robot, starts[1], **BATCH, seed=1)
    assert single.design.shape == starts[1].shape and single.trajectory.shape == (
        51,
        len(starts[1]),
    )
    assert isinstance(single.objective, float) and single.history.shape == (51,)
    # Adam divides by the gradient's size, which amplifies rounding where that is near zero.
    np.testing.assert_allclose(single.trajectory, batch.trajectory[:, 1], atol=5e-3)
    assert single.objective == pytest.approx(float(batch.objective[1]), abs=1e-3)


def test_a_search_repeats_exactly_and_depends_on_its_seed(agent, robot, starts):
    one, same, other = (
        search("vgds", agent, robot, starts, **BATCH, seed=seed) for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(one.trajectory, same.trajectory)
    assert not np.array_equal(one.trajectory, other.trajectory)


def test_another_penalty_seed_reference_or_critic_is_not_compiled_anew(agent, robot, space, starts):
    search("vgds", agent, robot, starts, **BATCH)
    other = dataclasses.replace(agent, critic=jax.tree.map(lambda x: 0.5 * x, agent.critic))
    changed = search(
        "vgds", other, robot, starts, **BATCH, trust_region=3, seed=9, reference=space.start(1)
    )
    assert changed.compile_seconds == 0


def test_a_strong_penalty_pulls_to_the_reference(agent, robot, space, starts):
    reference = 0.5 * space.start(8)
    found = search("vgds", agent, robot, starts, **BATCH, trust_region=1e6, reference=reference)
    assert np.sqrt(np.mean((found.design - reference) ** 2)) < 0.1


def test_errors(agent, robot, space, tmp_path):
    f = space.reference
    cases = [
        (dict(method="vdgs"), "no method 'vdgs'; did you mean 'vgds'.*penalty-only"),
        (dict(trust_region=-1.0), "trust_region is -1.0"),
        (dict(trust_region=np.nan), "trust_region is nan"),
        (dict(trust_region="much"), "trust_region is 'much'"),
        (dict(f=f[:-1]), rf"expected \[..., {space.dim}\]"),
        (dict(f=np.zeros((0, space.dim))), "at least one row"),
        (dict(f=np.zeros((1, 1, space.dim))), "expected one design"),
        (dict(f=f + 1.5), r"expected \[-1, 1\].*clip"),
        (dict(f=f * np.nan), "finite"),
        (dict(reference=f[:3]), "design has shape"),
        (dict(reference=np.zeros((2, space.dim))), "expected one design"),
        (dict(batch_size=0), "batch_size is 0"),
        (dict(steps=3), "no setting 'steps'; its settings are iterations, learning_rate"),
        (dict(robot=tiny_robot(tmp_path, 3), f=None), "no states with the 3 joints"),
        (
            dict(states=jax.tree.map(lambda x: x[:, :1], agent.states)),
            r"states.general has shape \(24, 1\); expected \[M, 13\]",
        ),
    ]
    for changes, message in cases:
        arguments = dict(method="vgds", agent=agent, robot=robot, f=f) | changes
        if arguments["f"] is None:
            arguments["f"] = DesignSpace(arguments["robot"]).reference
        with pytest.raises(ValueError, match=message):
            search(**arguments)
