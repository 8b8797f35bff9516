"""Evaluation of designs: paired episodes, frozen returns, statistics."""

import jax
import numpy as np
import pytest

from shapebody.design.space import DesignSpace
from shapebody.evaluation.evaluate import EvaluationConfig, evaluate
from shapebody.evaluation.statistics import bootstrap_interval, paired_gain
from shapebody.physics.native import NativePhysics
from shapebody.task.config import TaskConfig
from shapebody.task.env import Locomotion

HORIZON = 40
TASK = TaskConfig.evaluation(horizon=HORIZON)
CONFIG = EvaluationConfig(episodes=4, task=TASK, num_envs=8)


pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture(scope="module")
def space(robot):
    return DesignSpace(robot)


def native(agent, robot, designs, config=CONFIG, **arguments):
    return evaluate(agent, robot, designs, config=config, engine="native", **arguments)


def test_defaults_are_the_papers():
    config = EvaluationConfig()
    assert (config.episodes, config.coefficient) == (200, 1.0)
    assert config.task == TaskConfig.evaluation() and config.task.horizon == 1000


def test_episodes_are_paired_by_their_number(agent, robot, space):
    f = 0.2 * space.start(0)
    score = native(agent, robot, np.stack([f, f]), seed=5)
    np.testing.assert_allclose(score.returns[0], score.returns[1], atol=1e-6)
    np.testing.assert_allclose(score.tracking_error[0], score.tracking_error[1], atol=1e-6)
    # Different episodes of the same design differ, and so do those of another seed.
    assert len(np.unique(score.tracking_error[0].round(6))) == 4
    other = native(agent, robot, np.stack([f, f]), seed=6)
    assert not np.allclose(score.tracking_error, other.tracking_error)


def test_shapes_settings_and_repetition(agent, robot, space):
    designs = np.stack([space.reference, space.start(0)])
    score = native(agent, robot, designs, seed=1)
    assert score.returns.shape == score.lengths.shape == score.finite.shape == (2, 4)
    assert score.mean.shape == (2,) and score.non_finite.shape == (2,)
    again = native(agent, robot, designs, seed=1)
    np.testing.assert_array_equal(score.returns, again.returns)
    settings = score.settings
    assert settings["engine"] == "native" and settings["agent_hash"] == agent.hash
    assert settings["seed"] == 1 and settings["task"]["horizon"] == HORIZON
    assert score.summary().count("\n") == 1 and "of 4 episodes" in score.summary()

    single = native(agent, robot, space.reference, episodes=8, seed=1)
    assert single.returns.shape == (8,) and isinstance(single.mean, float)
    assert isinstance(single.non_finite, int) and isinstance(single.interval()[0], float)
    # More episodes leave the first ones as they are, but for the rounding of another batch.
    np.testing.assert_allclose(single.returns[:4], score.returns[0], atol=1e-3)


def test_chunks_give_the_same_episodes(agent, robot, space):
    designs = np.stack([space.reference, space.start(0)])
    whole = native(agent, robot, designs)
    parts = native(agent, robot, designs, EvaluationConfig(episodes=4, task=TASK, num_envs=3))
    np.testing.assert_array_equal(parts.lengths, whole.lengths)
    np.testing.assert_allclose(parts.returns, whole.returns, atol=1e-2)
    assert parts.returns.shape == (2, 4)


def test_against_a_plain_loop(agent, robot, space):
    """At c = 0.3 the untrained policy falls: episodes end at different steps and stay ended."""
    config = EvaluationConfig(episodes=8, coefficient=0.3, task=TASK, num_envs=8)
    f = 0.3 * space.start(1)
    score = native(agent, robot, f, config, seed=2)

    env = Locomotion(robot, 8, "native", TASK, auto_reset=False)
    key = jax.random.PRNGKey(2)
    keys = np.stack([jax.random.fold_in(key, i) for i in range(8)])
    state = env.reset(key, f, coefficient=0.3, keys=keys)

    def policy(params, key, descriptions, observation):
        return agent.act(descriptions, observation), ()

    returns, errors, lengths, alive = np.zeros(8), np.zeros(8), np.zeros(8), np.ones(8, bool)
    for _ in range(HORIZON):
        state, record, _ = env.step(policy, (), state, key)
        returns += alive * record.reward
        lengths += alive
        errors = np.where(alive, record.episode_error, errors)
        alive &= ~(record.terminated | record.truncated)
    assert len(np.unique(lengths)) > 2
    np.testing.assert_array_equal(score.lengths, lengths)
    np.testing.assert_allclose(score.returns, returns, atol=1e-3)
    np.testing.assert_allclose(score.tracking_error, errors, atol=1e-4)


def test_broken_simulations_end_and_are_counted(agent, robot, space, monkeypatch):
    whole = native(agent, robot, space.reference, episodes=8)
    step, count = NativePhysics.step, iter(range(1, 100))

    def failing(*arguments, **options):
        readings = step(*arguments, **options)
        finite = np.array(readings.finite)
        finite[3] &= next(count) != 5
        return readings._replace(finite=finite)

    monkeypatch.setattr(NativePhysics, "step", failing)
    score = native(agent, robot, space.reference, episodes=8)
    assert score.non_finite == 1 and not score.finite[3]
    assert score.lengths[3] == 5 and np.isfinite(score.returns).all()
    others = np.arange(8) != 3
    np.testing.assert_array_equal(score.lengths[others], whole.lengths[others])
    np.testing.assert_allclose(score.returns[others], whole.returns[others], atol=1e-5)


@pytest.mark.slow
def test_mjx_agrees_with_native(agent, robot, space):
    config = EvaluationConfig(episodes=2, task=TaskConfig.evaluation(horizon=4), num_envs=2)
    one = native(agent, robot, 0.2 * space.start(0), config)
    two = evaluate(agent, robot, 0.2 * space.start(0), engine="mjx", config=config)
    assert two.settings["engine"] == "mjx"
    np.testing.assert_array_equal(one.lengths, two.lengths)
    np.testing.assert_allclose(one.returns, two.returns, atol=3e-2)
    np.testing.assert_allclose(one.tracking_error, two.tracking_error, atol=5e-3)


def test_errors(agent, robot, space):
    f = space.reference
    cases = [
        (dict(designs=f[:-1]), "design has shape"),
        (dict(designs=f + 2), "clip"),
        (dict(designs=np.zeros((1, 1, space.dim))), "designs have shape"),
        (dict(designs=np.zeros((0, space.dim))), "designs have shape"),
        (dict(designs=f, episodes=0), "episodes is 0"),
        (dict(designs=f, episodes=2, engine="bullet"), "engine is 'bullet'"),
    ]
    for arguments, message in cases:
        with pytest.raises(ValueError, match=message):
            evaluate(agent, robot, **arguments)
    for name in ("episodes", "num_envs"):
        for value in (2.0, "a", float("nan"), True, -1):
            with pytest.raises(ValueError, match=f"{name} is {value!r}; expected an integer"):
                EvaluationConfig(**{name: value})
    assert EvaluationConfig(episodes=np.int64(3)).episodes == 3
    for value in (2, "a", float("nan")):
        with pytest.raises(ValueError, match=f"coefficient is {value!r}; expected"):
            EvaluationConfig(coefficient=value)


# statistics


def test_interval_of_many_numbers_is_the_normal_one():
    values = np.random.default_rng(0).normal(3, 2, size=500)
    low, high = bootstrap_interval(values, seed=1)
    error = 1.96 * values.std() / np.sqrt(500)
    assert low == pytest.approx(values.mean() - error, abs=0.02)
    assert high == pytest.approx(values.mean() + error, abs=0.02)
    narrow = bootstrap_interval(values, confidence=0.5)
    assert low < narrow[0] < narrow[1] < high
    assert bootstrap_interval(values, seed=1) == (low, high)


def test_interval_of_two_numbers_is_known():
    # Means of two draws from {0, 1}: 0, 1/2 and 1 with probabilities 1/4, 1/2 and 1/4.
    assert bootstrap_interval([0, 1]) == (0.0, 1.0)
    assert bootstrap_interval([0, 1], confidence=0.4) == (0.5, 0.5)
    assert bootstrap_interval([4.0]) == (4.0, 4.0)


def test_paired_differences():
    rng = np.random.default_rng(0)
    before = rng.normal(size=(3, 10))
    low, high = bootstrap_interval(before + 1, before)
    np.testing.assert_allclose([low, high], np.ones((2, 3)))
    noise = 0.1 * rng.normal(size=(3, 10))
    low, high = bootstrap_interval(before + 1 + noise, before)
    assert np.all(low > 0.85) and np.all(high < 1.15) and np.all(low < high)


def test_gain_is_resampled_over_starts_and_episodes():
    starts, episodes = np.arange(4.0)[:, None], np.tile([-10.0, 10.0], 25)
    gain = paired_gain(starts + np.zeros(50), np.zeros((4, 50)))
    np.testing.assert_allclose(gain.differences, [0, 1, 2, 3])
    assert gain.mean == pytest.approx(1.5)
    assert (gain.low, gain.high) == pytest.approx(bootstrap_interval([0, 1, 2, 3]), abs=0.06)
    # Luck with the episodes is common to all starts: more starts do not average it out.
    common = paired_gain(np.tile(episodes, (400, 1)), np.zeros((400, 50)))
    assert (common.low, common.high) == pytest.approx(bootstrap_interval(episodes), abs=0.3)
    both = paired_gain(starts + episodes, np.zeros((4, 50)))
    variance = starts.var() / 4 + episodes.var() / 50
    assert both.high - both.low == pytest.approx(2 * 1.96 * variance**0.5, rel=0.05)
    single = paired_gain(episodes, np.zeros(50))
    assert single.mean == pytest.approx(0) and single.high > 2


def test_gain_of_evaluations(agent, robot, space):
    f = space.reference
    one, two = native(agent, robot, f), native(agent, robot, 0.5 * space.start(0))
    gain = paired_gain(two, one)
    np.testing.assert_allclose(gain.differences, two.returns - one.returns, atol=1e-6)
    other = native(agent, robot, f, seed=1)
    with pytest.raises(ValueError, match="differ in seed: 1 and 0"):
        paired_gain(other, one)


def test_statistics_refuse_bad_input():
    with pytest.raises(ValueError, match="lengths of at least 1"):
        bootstrap_interval([])
    with pytest.raises(ValueError, match="expected finite numbers"):
        bootstrap_interval([1.0, np.nan])
    with pytest.raises(ValueError, match="different shapes"):
        bootstrap_interval([1.0, 2.0], [1.0])
    with pytest.raises(ValueError, match="confidence is 95"):
        bootstrap_interval([1.0, 2.0], confidence=95)
    with pytest.raises(ValueError, match=r"\[E\] or \[S, E\]"):
        paired_gain(np.zeros((1, 2, 3)), np.zeros((1, 2, 3)))
