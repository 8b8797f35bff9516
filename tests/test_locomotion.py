"""The locomotion task: rewards, curriculum, commands, padding, failure, resume, two engines."""

import importlib.util
import json
from dataclasses import fields, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shapebody.design.descriptions import Sizes
from shapebody.robot.robot import load_robot
from shapebody.task import curriculum, episode, observations, randomization, rewards
from shapebody.task.config import CONTROL_STEP, TaskConfig
from shapebody.task.env import Locomotion
from shapebody.task.rewards import TERMS

QUIET = dict(
    noise_joint_position=0.0,
    noise_joint_velocity=0.0,
    noise_angular_velocity=0.0,
    noise_gravity=0.0,
    push_probability=0.0,
    command_change=0.0,
)


def wave(params, key, descriptions, observation):
    """Open-loop actions that depend on nothing random."""
    phase = jnp.arange(observation.joints.shape[-2])
    time = observation.general[:, 6:7]
    return 0.5 * jnp.sin(phase + 3 * time) * descriptions.joint_mask, ()


@pytest.fixture(scope="module")
def go2():
    return load_robot("unitree_go2")


@pytest.fixture(scope="module")
def env(go2):
    return Locomotion(go2, 6, config=TaskConfig(horizon=12), threads=1, engine="native")


def moment_of(state, index=0):
    """A reward `Moment` from environment `index` of a batch, with nothing going on."""
    one = jax.tree.map(lambda x: np.asarray(x)[index], state)
    return rewards.Moment(
        readings=one.readings,
        descriptions=one.descriptions,
        command=one.command,
        keep_nominal=one.keep_nominal,
        actions=one.actions,
        contact=one.contact,
        air_time=one.air_time,
        last_joint_velocity=one.readings.joint_velocity,
        last_linear_velocity=one.readings.linear_velocity,
        collisions=one.descriptions.nominal_collisions,
    )


def term(number, moment):
    return float(TERMS[number - 1].function(moment))


def test_reward_terms_by_hand(env):
    m = moment_of(env.reset(jax.random.PRNGKey(0), designs=np.zeros(358), coefficient=0.0))
    q = np.zeros(12)
    q[0] = 0.2
    tau = np.arange(12.0)
    readings = replace(
        m.readings,
        linear_velocity=np.array([0.5, -0.1, 0.2]),
        angular_velocity=np.array([0.1, 0.2, 0.3]),
        joint_velocity=np.full(12, 2.0),
        joint_torque=tau,
        joint_position=m.descriptions.nominal + q,
        foot_velocity=np.tile([0.3, 0.4, -0.5], (4, 1)),
        imu_height=m.descriptions.imu_height + 0.1,
        imu_quat=np.array([np.cos(0.15), np.sin(0.15), 0, 0]),
    )
    actions = np.stack([np.full(12, 1.0), np.full(12, 0.5), np.full(12, 0.25)])
    m = m._replace(
        readings=readings,
        command=np.array([1.0, 0.0, 0.0]),
        keep_nominal=np.ones(12),
        actions=actions,
        contact=np.array([1.0, 0.0, 0.0, 1.0]),
        air_time=np.array([0.05, 0.3, 0.3, 5.0]),
        last_joint_velocity=np.full(12, 1.0),
        last_linear_velocity=np.zeros(3),
        collisions=m.descriptions.nominal_collisions + 2,
    )
    wanted_air = 0.4 * float(np.mean(m.descriptions.dimensions))
    expected = {
        1: np.exp(-(0.25 + 0.01) / 0.25),
        2: np.exp(-0.09 / 0.25),
        3: 1.0,
        4: 1.0,
        5: -0.04,
        6: -(0.25 + 0.01 + 0.04) / CONTROL_STEP**2,
        7: -0.05,
        8: -(0.3**2),
        9: -0.04 / 12,
        12: -4.0,
        13: -((1.0 / CONTROL_STEP) ** 2),
        14: -np.mean(tau**2),
        15: -np.mean(2 * tau),
        16: -0.25,
        17: -((1 - 2 * 0.5 + 0.25) ** 2),
        18: -2.0,
        19: -0.01,
        20: min(0.05 - wanted_air, 0) / 4,
        22: -0.25 / 2,
        23: -0.25,
    }
    for number, value in expected.items():
        assert term(number, m) == pytest.approx(value, rel=1e-4), TERMS[number - 1].name
    # Feet 1 and 2 are in the air; the pairs of a quadruped are front and hind feet.
    pairs = np.argwhere(m.descriptions.foot_pairs > 0)
    in_air = [m.contact[a] + m.contact[b] == 0 for a, b in pairs]
    assert len(pairs) == 2 and term(21, m) == pytest.approx(-np.mean(in_air))
    # Limits: soft position limits and 90 % of the velocity limit.
    beyond = replace(
        readings,
        joint_position=m.descriptions.soft_limits[:, 1] + 0.1,
        joint_velocity=m.descriptions.velocity_limits,
    )
    m = m._replace(readings=beyond)
    assert term(10, m) == pytest.approx(-0.1, rel=1e-4)
    assert term(11, m) == pytest.approx(-0.1 * np.mean(m.descriptions.velocity_limits), rel=1e-4)


def test_terms_have_the_numbers_of_the_paper():
    for number, term in enumerate(TERMS, 1):
        assert term.number == number and term.function.__name__.startswith(f"t{number}_")
        assert term.function.__doc__.startswith(f"T{number}: ")


def test_standing_command_wants_no_air_time(env):
    m = moment_of(env.reset(jax.random.PRNGKey(0), designs=np.zeros(358)))
    m = m._replace(command=np.zeros(3), contact=np.ones(4), air_time=np.zeros(4))
    assert term(20, m) == 0.0


def test_combination_clips_and_scales_with_the_curriculum():
    terms = np.zeros(23)
    terms[:4] = 1.0
    assert rewards.combine(terms, 0.0) == pytest.approx(0.02 * 3.0)
    assert rewards.combine(terms, 1.0) == pytest.approx(0.02 * 3.1)
    terms[4] = -100.0
    # The penalty can take everything except the unclipped alive reward.
    assert rewards.combine(terms, 1.0) == pytest.approx(0.02 * 0.05)
    assert rewards.combine(terms, 0.0) == pytest.approx(0.02 * 3.0)


def test_curriculum_accelerates_and_falls_back():
    config = TaskConfig()
    c, streak, history = 0.0, 0, []
    for success in [True] * 14 + [False, False, True]:
        c, streak = curriculum.update(config, c, jnp.asarray(streak), jnp.asarray(success))
        history.append(round(float(c), 3))
    assert history[:4] == [0.01, 0.03, 0.06, 0.1]
    assert history[13] == 1.0 and history[14:] == [0.99, 0.97, 0.98]
    assert bool(curriculum.is_success(config, 0.39, 500, 1.0, -5.0))
    assert not bool(curriculum.is_success(config, 0.41, 1000, 1.0, 20.0))
    assert not bool(curriculum.is_success(config, 0.1, 499, 1.0, 20.0))
    # In the ancestors, a long or accurate episode is none: only its return counts.
    ancestors = TaskConfig.ancestors()
    assert bool(curriculum.is_success(ancestors, 0.9, 300, 1.0, 8.0))
    assert not bool(curriculum.is_success(ancestors, 0.1, 1000, 1.0, 7.9))


def test_the_rule_by_return_moves_c(go2):
    """Episodes that stand still and fall short of the return lower c; with a bar of 0, they raise
    it, however badly they track."""
    for bar, expected in ((1e3, 0.49), (0.0, 0.51)):
        config = TaskConfig(
            **QUIET,
            curriculum_success="return",
            curriculum_return=bar,
            curriculum_error=0.0,
            curriculum_length=2,
            horizon=2,
        )
        env = Locomotion(go2, 3, config=config, threads=1, engine="native")
        state = env.reset(jax.random.PRNGKey(0), designs=np.zeros(358), coefficient=0.5)
        state, trajectory = env.rollout(wave, None, state, jax.random.PRNGKey(0), 2)
        assert np.all(trajectory.truncated[1])
        np.testing.assert_allclose(state.coefficient, expected, rtol=1e-6)


@pytest.mark.parametrize("engine", ["native", pytest.param("mjx", marks=pytest.mark.slow)])
def test_episodes_cut_short_leave_the_curriculum(go2, engine):
    """One environment is cut after a step, one falls in it, one lasts until it is a success."""
    config = TaskConfig(**QUIET, horizon=2, curriculum_length=2, curriculum_error=1e9)
    env = Locomotion(go2, 3, config=config, engine=engine)
    state = env.reset(jax.random.PRNGKey(0), coefficient=0.5)
    height = np.asarray(state.descriptions.imu_height) * [1, 100, 1]
    state = replace(
        state,
        descriptions=replace(state.descriptions, imu_height=jnp.asarray(height, jnp.float32)),
        horizon=jnp.array([1, 2, 2], jnp.int32),
        streak=jnp.array([3, 3, 3], jnp.int32),
    )
    state, trajectory = env.rollout(wave, None, state, jax.random.PRNGKey(0), 2)
    np.testing.assert_array_equal(trajectory.truncated, [[1, 0, 0], [0, 0, 1]])
    np.testing.assert_array_equal(trajectory.terminated, [[0, 1, 0], [0, 0, 0]])
    np.testing.assert_array_equal(state.streak, [3, -1, 4])
    np.testing.assert_allclose(state.coefficient, [0.5, 0.49, 0.54], rtol=1e-6)


def test_commands_follow_their_distribution():
    config = TaskConfig()
    keys = jax.random.split(jax.random.PRNGKey(0), 20_000)
    commands = np.asarray(jax.vmap(lambda key: randomization.draw_command(config, key, 0.8))(keys))
    standing = np.all(commands == 0, 1)
    assert np.abs(commands).max() <= 0.8
    nonzero = np.abs(commands[commands != 0])
    assert nonzero.min() >= 0.08
    # 4 % by choice and 0.1 % because all three components fell into the dead zone.
    assert standing.mean() == pytest.approx(0.041, abs=0.005)
    assert (commands[~standing] == 0).mean() == pytest.approx(0.105, abs=0.01)


def test_delay_and_clipping_of_actions(env):
    config = TaskConfig(action_delay=1, **QUIET)
    state = env.reset(jax.random.PRNGKey(0), designs=np.zeros(358), coefficient=1.0)
    one = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[0]), state)
    d = one.descriptions
    one, target, _, _ = episode.control(config, one, jnp.full(12, 20.0))
    np.testing.assert_allclose(target, d.nominal)
    one, target, _, _ = episode.control(config, one, jnp.zeros(12))
    np.testing.assert_allclose(target, d.nominal + d.action_scale * 10.0, rtol=1e-6)
    with pytest.raises(ValueError, match="action_delay is 2"):
        TaskConfig(action_delay=2)


def test_share_of_late_actions():
    """In the ancestors only mixed episodes are late, in half of their steps: 2.5 % of all steps.
    Ours adds half of all episodes, and the evaluation delays every action by one step."""
    keys = jax.random.split(jax.random.PRNGKey(0), 40_000)

    def share(config):
        base, mixed = jax.vmap(lambda key: randomization.draw_delay(config, key))(keys)
        return np.where(mixed, 0.5, base).mean()

    assert share(TaskConfig.ancestors()) == pytest.approx(0.025, abs=0.003)
    assert share(TaskConfig()) == pytest.approx(0.5, abs=0.01)
    assert share(TaskConfig(delay_probability=1.0, mixed_delay=0.0)) == 1
    assert share(TaskConfig.evaluation()) == 1


@pytest.mark.parametrize("kind", ["trunk", "joint"])
def test_too_fast_ends_an_episode(env, kind):
    state = env.reset(jax.random.PRNGKey(0), designs=np.zeros(358), coefficient=0.0)
    one = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[0]), state)
    name = f"{kind}_velocity"

    def ends(config, speed):
        fast = replace(one.readings, **{name: getattr(one.readings, name).at[3].set(speed)})
        after, outcome = episode.advance(config, one, fast)
        return after, bool(outcome.terminated)

    for speed in (101.0, -101.0):
        after, terminated = ends(TaskConfig.ancestors(), speed)
        assert terminated
        assert np.abs(after.readings.trunk_velocity).max() <= 100
        assert not ends(TaskConfig(), speed)[1]
    assert not ends(TaskConfig.ancestors(), 99.0)[1]


def test_nominal_start_at_zero_coefficient(env, go2):
    state = env.reset(jax.random.PRNGKey(1), designs=np.zeros(358), coefficient=0.0)
    np.testing.assert_allclose(state.readings.joint_position[:, :12], [go2.nominal] * 6, atol=1e-6)
    np.testing.assert_allclose(
        np.asarray(state.readings.foot_position)[..., 2].min(1), 0, atol=1e-6
    )
    np.testing.assert_allclose(state.readings.imu_height, state.descriptions.imu_height, atol=1e-6)
    _, observation = env.batch.observe(state)
    assert np.abs(observation.joints[..., :3]).max() < 1e-6
    np.testing.assert_allclose(observation.general[:, 10:], [[0, 0, -1]] * 6, atol=1e-6)
    np.testing.assert_allclose(observation.privileged[:, 4], 0)


def test_rollout_bookkeeping(env):
    state = env.reset(jax.random.PRNGKey(2), coefficient=0.3, spread=True)
    state, trajectory = env.rollout(wave, None, state, jax.random.PRNGKey(0), 20)
    done = np.asarray(trajectory.terminated | trajectory.truncated)
    assert done.any(0).all()
    length = np.asarray(trajectory.episode_length)
    assert np.array_equal(length[1:], np.where(done[:-1], 1, length[:-1] + 1))
    # The description that `slot` selects is the one whose nominal action scale the step used.
    number = np.cumsum(done, 0) - done
    for n in range(6):
        first, last = number[:, n] == 0, number[:, n] == done[:, n].sum()
        assert np.array_equal(trajectory.valid[:, n] > 0, first | last)
        assert np.array_equal(trajectory.slot[:, n] > 0, last)
    for leaf in jax.tree.leaves(trajectory.observation):
        assert np.isfinite(leaf).all() and np.abs(leaf).max() <= 10
    np.testing.assert_array_equal(trajectory.descriptions.joints[1], state.descriptions.joints)


def test_padding_and_company_change_nothing(go2):
    config = TaskConfig(**QUIET)
    golem = load_robot("golem")
    keys = jax.random.split(jax.random.PRNGKey(3), 4)
    alone = Locomotion(go2, 2, config=config, threads=1, engine="native")
    mixed = Locomotion([go2, golem], 4, config=config, threads=1, engine="native")
    start = go2.design_dim
    designs = np.zeros((4, golem.design_dim), np.float32)
    designs[:, :start] = np.random.default_rng(0).uniform(-0.5, 0.5, (4, start))
    designs[:2, start:] = np.nan  # padding
    a = alone.reset(None, designs=designs[:2, :start], keys=keys[:2])
    b = mixed.reset(None, designs=designs, keys=keys)
    assert mixed.sizes == Sizes.of(go2, golem)
    for _ in range(2):
        a, short = alone.rollout(wave, None, a, jax.random.PRNGKey(0), 4)
        b, padded = mixed.rollout(wave, None, b, jax.random.PRNGKey(0), 4)
        np.testing.assert_allclose(padded.reward[:, :2], short.reward, rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(
            padded.observation.joints[:, :2, :12], short.observation.joints, rtol=1e-3, atol=1e-5
        )
    assert np.all(np.asarray(padded.observation.joints)[:, :2, 12:] == 0)
    with pytest.raises(ValueError, match=r"shape \(4, 358\); expected one design \[688\]"):
        mixed.reset(None, designs=designs[:, :start], keys=keys)
    with pytest.raises(ValueError, match="designs of robot 'golem': design entry .* is nan"):
        mixed.reset(None, designs=designs[0], keys=keys)
    with pytest.raises(ValueError, match="2 robots need"):
        Locomotion([go2, golem], 1)
    with pytest.raises(ValueError, match="engine is 'bullet'"):
        Locomotion(go2, 1, engine="bullet")


def test_designs_are_checked(env):
    key, zeros = jax.random.PRNGKey(0), np.zeros(358)
    state = env.reset(key, designs=zeros[None])
    keys = jax.random.split(key, 2)
    before = env.physics_arrays()
    for designs, message in [
        (zeros[1:], r"shape \(357,\); expected one design \[358\] or"),
        (np.zeros((3, 358)), r"shape \(3, 358\); expected"),
        (np.zeros(()), r"shape \(\)"),
        (zeros + 1.1, r"is 1.1.*, expected \[-1, 1\]"),
        (zeros * np.nan, "is nan, expected a finite number"),
    ]:
        with pytest.raises(ValueError, match=message):
            env.reset(key, designs=designs)
        with pytest.raises(ValueError, match=message):
            env.restart(state, [1, 4], keys, designs)
    for wrong in (zeros, np.zeros((0, 358)), np.zeros((2, 357)), np.full((1, 358), 2.0)):
        with pytest.raises(ValueError, match="expected"):
            env.descriptions(0, wrong)
    for old, new in zip(
        jax.tree.leaves(before), jax.tree.leaves(env.physics_arrays()), strict=True
    ):
        np.testing.assert_array_equal(old, new)


def test_steps_are_for_the_native_engine(go2, env):
    state = env.reset(jax.random.PRNGKey(0), designs=np.zeros(358))
    other = Locomotion(go2, 6, "mjx")
    for call in (
        lambda: other.step(wave, None, state, jax.random.PRNGKey(0)),
        lambda: other.restart(state, [0], jax.random.split(jax.random.PRNGKey(0), 1)),
        other.physics_arrays,
    ):
        with pytest.raises(ValueError, match="is for the native engine, and .* runs on 'mjx'"):
            call()


def test_without_auto_reset_an_environment_goes_on(go2):
    """As the documentation of `auto_reset` says: whoever steps it has to note the end."""
    config = TaskConfig(**QUIET, horizon=1)
    env = Locomotion(go2, 2, config=config, threads=1, engine="native", auto_reset=False)
    state = env.reset(jax.random.PRNGKey(0), designs=np.zeros(358), coefficient=0.0)
    _, trajectory = env.rollout(wave, None, state, jax.random.PRNGKey(0), 3)
    assert np.all(np.asarray(trajectory.truncated) | np.asarray(trajectory.terminated))
    assert np.all(np.diff(trajectory.episode_return, axis=0) > 0)
    np.testing.assert_array_equal(trajectory.episode_length[:, 0], [1, 2, 3])


NUMBERS = [
    field.name
    for field in fields(TaskConfig)
    if type(getattr(TaskConfig(), field.name)) in (int, float)
] + ["command_limit", "action_delay", "velocity_bound"]


@pytest.mark.parametrize("name", NUMBERS)
def test_settings_without_sense_are_named(name):
    for wrong in (-1, float("nan"), float("inf"), "much", True):
        with pytest.raises(ValueError, match=f"^{name} is .*; expected"):
            TaskConfig(**{name: wrong})


def test_ranges_of_settings():
    shares = ("command_change", "command_all_zero", "command_single_zero", "mixed_delay")
    for name in (*shares, "push_probability", "push_add", "delay_probability"):
        assert getattr(TaskConfig(**{name: 1}), name) == 1
        with pytest.raises(ValueError, match=f"{name} is 1.1; expected a probability"):
            TaskConfig(**{name: 1.1})
    for name in ("horizon", "curriculum_levels", "curriculum_length"):
        for wrong in (0, 2.0):
            with pytest.raises(ValueError, match=f"{name} is {wrong}; expected an integer"):
                TaskConfig(**{name: wrong})
    with pytest.raises(ValueError, match="command_limit is 0"):
        TaskConfig(command_limit=0)
    with pytest.raises(ValueError, match="velocity_bound is 0; expected a positive number"):
        TaskConfig(velocity_bound=0)
    with pytest.raises(ValueError, match="curriculum_success is 'length'; expected 'tracking' or"):
        TaskConfig(curriculum_success="length")


def test_a_broken_simulation_ends_alone(go2):
    config = TaskConfig(**QUIET)
    env = Locomotion(go2, 3, config=config, threads=1, engine="native", auto_reset=False)
    keys = jax.random.split(jax.random.PRNGKey(4), 3)

    def run(breaks):
        state = env.reset(None, designs=np.zeros(358), keys=keys)
        records = []
        for t in range(3):
            if breaks and t == 1:
                env.groups[0].physics.qpos[1] = np.nan
            state, record, _ = env.step(wave, None, state, jax.random.PRNGKey(t))
            records.append(record)
        return jax.tree.map(lambda *x: np.stack(x), *records)

    good, bad = run(False), run(True)
    assert not bad.finite[1, 1] and bad.terminated[1, 1] and bad.reward[1, 1] == 0
    assert np.isfinite(bad.reward).all() and np.isfinite(bad.observation.joints).all()
    for i in (0, 2):
        np.testing.assert_array_equal(bad.reward[:, i], good.reward[:, i])


def test_restore_continues_exactly(go2):
    def make():
        return Locomotion(go2, 4, config=TaskConfig(horizon=9), threads=1, engine="native")

    env = make()
    state = env.reset(jax.random.PRNGKey(5), coefficient=0.5, spread=True)
    state, _ = env.rollout(wave, None, state, jax.random.PRNGKey(0), 5)
    saved = env.physics_arrays()
    _, expected = env.rollout(wave, None, state, jax.random.PRNGKey(1), 8)
    other = make()
    other.reset(jax.random.PRNGKey(6))
    other.restore(state, saved)
    _, got = other.rollout(wave, None, state, jax.random.PRNGKey(1), 8)
    for x, y in zip(jax.tree.leaves(expected), jax.tree.leaves(got), strict=True):
        np.testing.assert_array_equal(x, y)


def test_box_feet_touch_with_their_lowest_corner():
    robot = load_robot("mit_humanoid")
    env = Locomotion(robot, 1, threads=1, engine="native")
    state = env.reset(jax.random.PRNGKey(0), designs=np.zeros(514), coefficient=0.0)
    one = jax.tree.map(lambda x: np.asarray(x)[0], state)
    # Foot centres are at floor height, so the soles are below it.
    assert np.array_equal(observations.foot_contact(one.readings, one.descriptions), [1, 1])
    lowest = np.abs(one.readings.foot_down * one.descriptions.foot_size).sum(-1)
    for height, touching in [(lowest * 0.99, 1), (lowest * 1.01, 0)]:
        position = one.readings.foot_position.copy()
        position[:, 2] = height
        readings = replace(one.readings, foot_position=position)
        assert np.all(observations.foot_contact(readings, one.descriptions) == touching)


@pytest.mark.slow
def test_engines_agree_on_the_task(go2):
    """The same designs and actions on both engines: rewards and observations stay close."""
    config = TaskConfig(**QUIET)
    keys = jax.random.split(jax.random.PRNGKey(7), 4)
    designs = np.random.default_rng(1).uniform(-0.3, 0.3, (4, 358)).astype(np.float32)
    trajectories = []
    for engine in ("native", "mjx"):
        options = dict(solver_iterations=4, line_search=8)
        env = Locomotion(go2, 4, engine, config, physics_options=options)
        state = env.reset(jax.random.PRNGKey(0), designs=designs, keys=keys)
        trajectories.append(env.rollout(wave, None, state, jax.random.PRNGKey(0), 12)[1])
    c, mjx = trajectories
    assert np.array_equal(c.terminated, mjx.terminated)
    np.testing.assert_allclose(c.observation.joints, mjx.observation.joints, atol=2e-3)
    np.testing.assert_allclose(c.observation.feet, mjx.observation.feet, atol=0.05)
    np.testing.assert_allclose(c.reward, mjx.reward, atol=2e-3)


def test_other_settings_share_what_starts_episodes(go2):
    env = Locomotion(go2, 2, config=TaskConfig(**QUIET), threads=1, engine="native")
    fixed = env.with_task(replace(env.config, fixed_coefficient=True))
    assert fixed.groups is env.groups and not env.config.fixed_coefficient
    with pytest.raises(ValueError, match="initial_tilt is 0.5 instead of"):
        env.with_task(replace(env.config, initial_tilt=0.5))


@pytest.mark.parametrize("engine", ["native", "mjx"])
def test_restarted_episodes_have_designs_at_every_distance(go2, engine):
    changes = dict(horizon=2, design_radius=(0, 1), fixed_coefficient=True)
    env = Locomotion(go2, 64, config=TaskConfig(**QUIET, **changes), engine=engine)
    first = env.reset(jax.random.PRNGKey(0), coefficient=0.5)
    before = np.array(first.design)
    state, _ = env.rollout(wave, None, first, jax.random.PRNGKey(0), 3)
    designs = np.asarray(state.design)
    assert not np.any(np.all(designs == before, axis=-1))
    size = 2 * np.sqrt(3 * np.mean(designs**2, -1))
    assert size.min() < 0.15 and size.max() > 0.85 and abs(size.mean() - 0.5) < 0.12


@pytest.mark.parametrize("engine", ["native", "mjx"])
def test_a_design_may_come_again_after_a_fall(robot, engine):
    def repeated(height, **changes):
        """The share of episodes of one step that are followed by one of the same design."""
        config = TaskConfig(**QUIET, termination_height=height, horizon=1, **changes)
        config = replace(config, fixed_coefficient=True)
        env = Locomotion(robot, 64, config=config, engine=engine)
        first = env.reset(jax.random.PRNGKey(0), coefficient=0.2)
        before = np.array(first.design)
        state, steps = env.rollout(wave, None, first, jax.random.PRNGKey(0), 1)
        assert np.all(steps.terminated if height > 1 else steps.truncated)
        same = np.all(np.asarray(state.design) == before, axis=-1)
        np.testing.assert_array_equal(steps.descriptions.joints[0], first.descriptions.joints)
        assert np.all(np.any(np.asarray(state.key) != first.key, axis=-1))  # another episode of it
        return same.mean()

    falls, stands = 5.0, 0.0
    assert 0.3 < repeated(falls, repeat_after_fall=0.5) < 0.7
    if engine == "native":  # every case is compiled, which takes MJX long
        assert repeated(falls) == 0
        assert repeated(falls, repeat_after_fall=1.0) == 1
        assert repeated(stands, repeat_after_fall=1.0) == 0


def test_designs_at_every_distance(go2):
    """Root mean square of a design: 1 / sqrt(3) times its radius, which is uniform."""

    def sizes(radius, c):
        config = TaskConfig(**QUIET, design_radius=radius)
        env = Locomotion(go2, 64, config=config, threads=1, engine="native")
        designs = np.asarray(env.reset(jax.random.PRNGKey(0), coefficient=c).design)
        return designs, np.sqrt(3 * np.mean(designs**2, -1)) / c

    far, size = sizes((1.0, 1.0), 0.5)
    assert np.abs(size - 1).max() < 0.15 and np.abs(far).max() <= 0.5
    any_distance, size = sizes((0, 1), 0.5)
    assert size.min() < 0.15 and size.max() > 0.85 and abs(size.mean() - 0.5) < 0.12
    # The radius scales the designs that would be drawn without it.
    np.testing.assert_allclose(any_distance / size[:, None], far, atol=0.08)
    for wrong in [(0.5, 0.2), (-0.1, 1.0), (0.0, 2.0), (0.0, np.nan), 0.5, (0.5,), None]:
        with pytest.raises(ValueError, match="design_radius"):
            TaskConfig(design_radius=wrong)


@pytest.fixture
def benchmarks():
    path = Path(__file__).parents[1] / "benchmarks" / "run.py"
    spec = importlib.util.spec_from_file_location("benchmarks_run", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_benchmark_of_the_environment_runs(benchmarks, monkeypatch):
    from shapebody.physics.native import NativePhysics

    monkeypatch.setattr(NativePhysics, "step", NativePhysics.step)  # restored afterwards
    monkeypatch.setattr(benchmarks, "ENVIRONMENTS", 4)
    rows = benchmarks.environment()
    assert 0 < rows["environment, C engine"][0] <= rows["C engine inside it"][0]


def test_benchmarks_keep_the_rows_of_others(benchmarks, tmp_path):
    path = str(tmp_path / "results.json")
    for name, label in [("engine", "a"), ("environment", "b"), ("engine", "c")]:
        rows = benchmarks._written(path, name, {label: {"value": 1, "benchmark": name}}, {})
    assert list(rows) == ["b", "c"] == list(json.loads(Path(path).read_text())["rows"])


def test_ratios_of_benchmarks_follow_their_rows(benchmarks):
    rows = {
        "environment, C engine": {"value": 3.0, "commit": "new"},
        "C engine alone": {"value": 4.0, "commit": "old"},
        "C engine inside it": {"value": 6.0, "commit": "new"},
        "environment / C engine alone": {"value": 0.9, "commit": "old"},
    }
    merged = benchmarks.with_ratios(rows)
    ratios = [merged[f"environment / C engine {where}"] for where in ("alone", "inside it")]
    assert [(row["value"], row["commit"]) for row in ratios] == [
        (0.75, "new and old"),
        (0.5, "new"),
    ]
    del rows["environment, C engine"]
    assert "environment / C engine alone" not in benchmarks.with_ratios(rows)
