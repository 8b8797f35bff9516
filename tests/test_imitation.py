"""Runs that begin with what another policy can do."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest
from tiny import quick_compilation, tiny_agent, tiny_robot

from shapebody.networks.config import CriticConfig, PolicyConfig
from shapebody.training import config as training_config
from shapebody.training import imitation, train
from shapebody.training import trainer as training_trainer


@pytest.fixture(scope="module", autouse=True)
def quick():
    with quick_compilation():
        yield


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return tiny_robot(tmp_path_factory.mktemp("robot"))


@pytest.fixture(scope="module")
def config(robot):
    return training_config.TrainConfig.smoke(
        robot.path,
        policy=PolicyConfig.reduced(key_widths=(12, 12), core_widths=(24, 12)),
        num_envs=16,
        rollout_length=8,
        minibatch_size=32,
        total_steps=1024,
    )


def test_the_student_acts_like_its_teacher(robot, config, tmp_path, capsys):
    teacher = tiny_agent(robot)
    own = replace(config, critic=teacher.critic_config)
    trainer = imitation.begin_run(own, teacher, steps=60 * config.batch, folder=tmp_path)
    assert "squared error" in capsys.readouterr().out
    record = json.loads((tmp_path / "training.json").read_text())[0]["imitated"]
    assert record["policy_hash"] == teacher.policy_hash
    assert (record["agent"], record["steps"]) == ("tiny", 60 * config.batch)
    # On states of the teacher's bank, which the student has not learned from.
    f = np.random.default_rng(0).uniform(-1, 1, (8, robot.design_dim)).astype(np.float32)
    bodies = jax.tree.map(lambda x: x[:, None], trainer.env.descriptions(0, f))
    wanted = np.asarray(teacher.act(bodies, teacher.states))
    student = trainer.agent().act(bodies, teacher.states)
    fresh = training_trainer.Trainer(own, tmp_path / "fresh").agent().act(bodies, teacher.states)
    errors = [np.mean((np.asarray(x) - wanted) ** 2) for x in (student, fresh)]
    assert errors[0] < 0.5 * errors[1]
    # The critic is the teacher's, and the run goes on like any other.
    for a, b in zip(
        jax.tree.leaves(trainer.learner.critic), jax.tree.leaves(teacher.critic), strict=True
    ):
        np.testing.assert_array_equal(a, b)
    assert trainer.steps == 0
    agent = train.train(own, tmp_path, progress=False, max_steps=2 * config.batch)
    assert agent.metadata["steps"] == 2 * config.batch
    assert agent.metadata["phases"][0]["imitated"] == record
    before = (tmp_path / "training.safetensors").read_bytes()
    with pytest.raises(ValueError, match="there is a run in .* already"):
        imitation.begin_run(own, teacher, folder=tmp_path)
    assert (tmp_path / "training.safetensors").read_bytes() == before


def test_teachers_that_do_not_fit(robot, config, tmp_path):
    other = tiny_agent(tiny_robot(tmp_path, legs=3))
    with pytest.raises(ValueError, match="the teacher 'tiny' is for legs_3, the run for legs_2"):
        imitation.begin_run(config, other, folder=tmp_path / "run")
    with pytest.raises(ValueError, match="steps is 0"):
        imitation.begin_run(config, tiny_agent(robot), steps=0, folder=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_critic_of_other_sizes_starts_anew(robot, config, tmp_path):
    teacher = tiny_agent(robot)
    own = replace(config, critic=CriticConfig.reduced(heads=1, head_widths=(8,)))
    trainer = imitation.begin_run(own, teacher, steps=config.batch, folder=tmp_path, progress=False)
    fresh = training_trainer.Trainer(own, tmp_path / "fresh").learner.critic
    for a, b in zip(jax.tree.leaves(trainer.learner.critic), jax.tree.leaves(fresh), strict=True):
        np.testing.assert_array_equal(a, b)
