import dataclasses

import pytest

from shapebody import load_robot
from shapebody.networks.config import PolicyConfig
from shapebody.reproduction import paper
from shapebody.training.config import TrainConfig


def test_values_that_the_paper_gives_twice_agree():
    for robot in paper.ROBOTS:
        assert paper.trust_region_gain(robot, 100) == paper.SINGLE_ROBOT[robot]["VGDS"]
        assert len(paper.TRUST_REGION[robot]) == len(paper.LAMBDAS)
    # The text names the best penalty of the Go2, and the best critic of the ablation.
    assert max(paper.TRUST_REGION["unitree_go2"]) == paper.trust_region_gain("unitree_go2", 100)
    assert max(row[-1] for row in paper.CRITIC_ABLATION) == 17.76


def test_every_table_names_the_same_robots():
    for table in (
        paper.DESIGN_DIMENSIONS,
        paper.SINGLE_ROBOT,
        paper.TRUST_REGION,
        paper.TRAINING_SETS,
        paper.COUNTERFACTUAL,
        paper.RL_CODESIGN,
    ):
        assert set(table) == set(paper.ROBOTS)
    methods = set(paper.SINGLE_ROBOT["golem"])
    for robot in paper.ROBOTS:
        assert set(paper.SINGLE_ROBOT[robot]) == methods == set(paper.TRAINING_SETS[robot])


def test_unknown_robot_or_penalty_has_no_value():
    assert paper.trust_region_gain("unitree_go2", 7) is None
    assert paper.trust_region_gain("spot", 100) is None


@pytest.mark.parametrize("robot", paper.ROBOTS)
def test_design_dimensions(robot):
    assert load_robot(robot).design_dim == paper.DESIGN_DIMENSIONS[robot]


def test_full_scale_has_the_hyperparameters():
    config = dataclasses.asdict(TrainConfig.full("unitree_go2"))
    assert {name: config[name] for name in paper.PPO} == paper.PPO
    policy = dataclasses.asdict(PolicyConfig())
    assert {name: policy[name] for name in paper.POLICY} == paper.POLICY
