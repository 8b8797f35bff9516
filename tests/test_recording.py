"""Recordings of single episodes."""

import numpy as np
import pytest

from shapebody.evaluation.evaluate import EvaluationConfig, evaluate
from shapebody.evaluation.recording import record_episode
from shapebody.task.config import TaskConfig
from shapebody.task.rewards import combine

pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture(scope="module")
def recording(agent, robot):
    return record_episode(agent, robot, seconds=0.4, command=(0.5, 0, 0.1), seed=3)


def test_shapes_and_command(recording, robot):
    steps = len(recording.reward)
    assert 1 <= steps <= 20
    assert recording.qpos.shape == (steps, robot.model.nq)
    assert recording.terms.shape == recording.weighted_terms.shape == (steps, 23)
    assert recording.contact.shape == (steps, robot.num_feet)
    assert recording.readings.joint_position.shape == (steps, robot.num_actuators)
    assert np.allclose(recording.command, [0.5, 0, 0.1])
    assert np.allclose(recording.observation.general[:, 3:6], [0.5, 0, 0.1])
    assert recording.ended in ("horizon", "fell", "not finite")


def test_rewards_follow_from_terms(recording):
    assert np.allclose(combine(recording.terms, 1.0), recording.reward, atol=1e-6)
    weighted = recording.weighted_terms
    inner = weighted.sum(1) - weighted[:, 3]
    assert np.allclose(np.maximum(inner, 0) + weighted[:, 3], recording.reward, atol=1e-6)


def test_repeats_and_seeds(agent, robot, recording):
    again = record_episode(agent, robot, seconds=0.4, command=(0.5, 0, 0.1), seed=3)
    assert np.array_equal(again.qpos, recording.qpos)
    other = record_episode(agent, robot, seconds=0.04, command=(0.5, 0, 0.1), seed=4)
    assert not np.allclose(other.qpos[0], recording.qpos[0])
    still = record_episode(
        agent, robot, seconds=0.02, command=(0.5, 0, 0.1), seed=4, coefficient=0.0
    )
    assert np.allclose(still.qpos[0, 7:], robot.nominal, atol=1e-6)


def test_reward_agrees_with_evaluation(agent, robot):
    # At c = 0 both start alike and nothing is random; a termination ends both.
    task = TaskConfig.evaluation(
        horizon=25, command_all_zero=1.0, command_change=0.0, push_probability=0.0
    )
    config = EvaluationConfig(episodes=1, coefficient=0.0, task=task)
    f = np.zeros(robot.design_dim, np.float32)
    score = evaluate(agent, robot, f, engine="native", config=config)
    one = record_episode(agent, robot, f, seconds=1.0, coefficient=0.0, task=task)
    assert len(one.reward) == score.lengths[0]
    assert np.isclose(one.reward.sum(), score.returns[0], rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"design": np.zeros(3)}, "expected"),
        ({"design": np.zeros((2, 1))}, "expected"),
        ({"seconds": 0.0}, "seconds"),
        ({"coefficient": 2.0}, "coefficient"),
        ({"command": (1, 2)}, "command"),
    ],
)
def test_bad_input(agent, robot, change, message):
    if "design" in change and change["design"].ndim == 2:
        change = {"design": np.zeros((2, robot.design_dim))}
    with pytest.raises(ValueError, match=message):
        record_episode(agent, robot, **change)
