"""The yardstick: fixed bodies, whole episodes, a rule of success, columns of the learning curve."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from tiny import tiny_robot

from shapebody.task.config import TaskConfig
from shapebody.task.env import Locomotion
from shapebody.task.whole_episodes import Episodes, play
from shapebody.training import progress, trainer, yardstick
from shapebody.training.config import TrainConfig

pytestmark = pytest.mark.usefixtures("quick")

COLUMNS = ("success_c1", "return_c1", "success_half", "return_half")


def test_bodies_are_the_same_for_all_policies_and_scale_with_c(agent, robot, monkeypatch):
    seen = []

    def caught(env, policy, prepare, episodes):
        seen.append(episodes)
        return play(env, policy, prepare, episodes)

    monkeypatch.setattr(yardstick, "play", caught)
    measured = [
        yardstick.yardstick(agent.policy_config, policy, robot, c, 6)
        for policy, c in (
            (agent.policy, 1.0),
            (jax.tree.map(lambda x: 2 * x, agent.policy), 1.0),
            (agent.policy, 0.5),
            (agent.policy, 1.0),
        )
    ]
    first, other, half, again = seen
    np.testing.assert_array_equal(first.designs, other.designs)
    np.testing.assert_array_equal(first.keys, other.keys)
    np.testing.assert_allclose(half.designs, 0.5 * first.designs)
    assert len(np.unique(first.designs[:, 0])) == len(np.unique(first.keys, axis=0)) == 6
    assert np.abs(first.designs).max() <= 1 and half.coefficient == 0.5
    np.testing.assert_array_equal(measured[0].returns, measured[3].returns)
    assert np.any(measured[0].returns != measured[1].returns)


def test_several_robots_share_the_bodies(agent, robot, tmp_path):
    other = tiny_robot(tmp_path, legs=1)
    env = Locomotion([robot, other], 6, config=TaskConfig.evaluation(), auto_reset=False)
    designs, keys = yardstick._fixed_bodies(env)
    dim = other.design_dim
    assert designs.shape == (6, robot.design_dim) and len(keys) == 6
    assert np.all(designs[3:, dim:] == 0) and np.all(designs[3:, :dim] != 0)
    assert yardstick.yardstick(agent.policy_config, agent.policy, [robot, other], 0.5, 6)


@pytest.mark.parametrize(
    "error, length, success",
    [(0.39, 1000, True), (0.41, 1000, False), (0.39, 500, True), (0.39, 499, False)],
)
def test_success_is_accurate_and_lasts(agent, robot, monkeypatch, error, length, success):
    def played(env, policy, prepare, episodes):
        results = episodes.empty()
        results.tracking_error[:] = error
        results.lengths[:] = length
        return results

    monkeypatch.setattr(yardstick, "play", played)
    measured = yardstick.yardstick(agent.policy_config, agent.policy, robot, 1.0, 6)
    assert measured.success.tolist() == [success] * 6


def test_one_episode_of_each_design(robot):
    """Numbers of episodes are those of the designs, and their keys differ."""
    designs = np.arange(6.0).reshape(3, 2)
    keys = np.arange(3)
    each = Episodes(designs, keys, one_each=True)
    assert each.total == 3 and Episodes(designs, keys).total == 9
    np.testing.assert_array_equal(each.of(np.array([2, 0]))[0], designs[[2, 0]])
    np.testing.assert_array_equal(each.of(np.array([2, 0]))[1], [2, 0])
    np.testing.assert_array_equal(Episodes(designs, keys).of(np.array([5, 3]))[0], designs[[1, 1]])
    np.testing.assert_array_equal(Episodes(designs, keys).of(np.array([5, 3]))[1], [2, 0])


def test_curve_has_the_yardstick_and_training_does_not_notice(robot, tmp_path, monkeypatch):
    monkeypatch.setattr(yardstick, "CURVE_BODIES", 4)
    config = TrainConfig.smoke(str(robot.path), total_steps=128 * 5)

    def run(name, interval, *budgets):
        for steps in budgets:
            new = trainer.Trainer(replace(config, yardstick_interval=interval), tmp_path / name)
            new.start()
            new.run(max_steps=steps, progress=False, curve_interval=1)
        rows, damaged = progress.read_rows(tmp_path / name / "training.csv")
        assert not damaged
        return new, rows

    straight, rows = run("straight", 256, 128 * 5)
    due = [all(row[name] for name in COLUMNS) for row in rows]
    assert due == [False, True, False, True, False]
    assert all(not row[name] for row in rows[::2] for name in COLUMNS)
    resumed, again = run("resumed", 256, 128 * 3, 128 * 5)
    assert [[row[name] for name in COLUMNS] for row in again] == [
        [row[name] for name in COLUMNS] for row in rows
    ]
    without, plain = run("without", None, 128 * 5)
    assert not any(row[name] for row in plain for name in COLUMNS)
    for other in (resumed, without):
        jax.tree.map(np.testing.assert_array_equal, straight.learner, other.learner)
