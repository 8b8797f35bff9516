"""What speaks against building a found body."""

from dataclasses import replace

import numpy as np
import pytest
from tiny import tiny_agent, tiny_robot

from shapebody.analysis.advice import LARGE_CHANGE, large_changes, objections
from shapebody.design.space import DesignSpace
from shapebody.evaluation.evaluate import EvaluationConfig, evaluate
from shapebody.robot.robot import load_robot
from shapebody.task.config import TaskConfig


@pytest.fixture(scope="module")
def space():
    return DesignSpace(load_robot("unitree_go2"))


def test_a_body_of_another_size_is_told(space):
    assert large_changes(space, space.reference) == []
    small = np.zeros(space.dim, np.float32)
    small[space.slices["size"]] = -0.5  # all lengths times 0.6
    told = large_changes(space, small)
    assert "(-78%)" in told[0] and told[0].startswith("mass ")
    assert all("(-40%)" in text for text in told[1:]) and len(told) == 5
    only_mass = large_changes(space, small, limit=0.5)
    assert only_mass == told[:1]


def test_mass_alone_is_told_alone(space):
    heavy = np.zeros(space.dim, np.float32)
    heavy[space.slices["coupled_mass"]] = 1.0
    (told,) = large_changes(space, heavy)
    assert told.startswith("mass ") and LARGE_CHANGE < 0.5


@pytest.fixture(scope="module")
def scores(tmp_path_factory):
    """Two bodies, of which the second is better in everything; standing still is worst."""
    robot = tiny_robot(tmp_path_factory.mktemp("robot"))
    config = EvaluationConfig(episodes=8, task=TaskConfig.evaluation(horizon=4))
    designs = np.zeros((2, DesignSpace(robot).dim), np.float32)
    one = evaluate(tiny_agent(robot), robot, designs, config=config)
    noise = np.random.default_rng(0).normal(0, 0.1, 8)

    def score(returns, errors, lengths):
        fill = [np.asarray(x, np.float32)[:, None] + 0 * noise for x in (errors, lengths)]
        returns = np.asarray(returns)[:, None] + noise * [[1], [2]]
        return replace(one, returns=returns, tracking_error=fill[0], lengths=fill[1])

    return score, score([1.0, 1.0], [0.5, 0.5], [900, 900])


@pytest.mark.parametrize(
    "returns, errors, lengths, expected",
    [
        ([3, 5], [0.3, 0.2], [900, 950], []),
        ([5, 5], [0.3, 0.2], [900, 950], ["not shown to earn more than the body as written"]),
        ([3, 5], [0.2, 0.3], [900, 950], ["tracks worse: 0.300 m/s, not 0.200 m/s"]),
        ([3, 5], [0.3, 0.2], [950, 900], ["falls earlier: 900 steps, not 950"]),
    ],
)
def test_each_objection_is_found(scores, returns, errors, lengths, expected):
    score, stood = scores
    found = objections(score(returns, errors, lengths), stood, 1)
    assert len(found) == len(expected)
    assert all(text.startswith(start) for text, start in zip(found, expected, strict=True))


def test_a_policy_has_to_beat_standing_still(scores):
    score, _ = scores
    walked = score([-1, 2], [0.3, 0.2], [900, 950])
    same = objections(walked, score([1, 3], [0.5, 0.5], [900, 900]), 1)
    other = objections(walked, score([3, 1], [0.5, 0.5], [900, 900]), 1)
    assert [text.split(":")[0] for text in same + other] == [
        "not shown to earn more than standing still with the same body",
        "not shown to earn more than standing still with the body as written",
    ]


def test_other_episodes_are_refused(scores):
    score, stood = scores
    strange = replace(stood, settings=stood.settings | {"seed": 1})
    with pytest.raises(ValueError, match="differ in seed"):
        objections(score([1, 2], [0.3, 0.2], [900, 950]), strange, 1)
