"""Whether a policy walks, stands or falls, and what a training run says of it."""

import types
from dataclasses import replace

import jax
import numpy as np
import pytest
from tiny import tiny_robot

from shapebody.agent.store import load_agent
from shapebody.robot.robot import load_robot
from shapebody.task.env import Locomotion
from shapebody.training import diagnosis, progress, trainer
from shapebody.training.config import TrainConfig
from shapebody.training.diagnosis import Diagnosis, diagnose

pytestmark = pytest.mark.usefixtures("quick")


def without_output(policy):
    """The same policy with all actions zero: the last layer of its core gives nothing."""
    params = policy["params"]
    last = max(name for name in params["core"] if name.startswith("layer_"))
    core = params["core"] | {last: jax.tree.map(np.zeros_like, params["core"][last])}
    return policy | {"params": params | {"core": core}}


def test_the_shipped_agent_walks_and_a_still_one_stands():
    agent, robot = load_agent("golem"), load_robot("golem")
    found = diagnose(agent.policy_config, agent.policy, robot)
    assert found.finding == "walks" and 0.5 < found.response < 1.2 and found.seconds == 10
    assert found.sentence().endswith("of the velocity that is commanded.")
    still = diagnose(agent.policy_config, without_output(agent.policy), robot)
    assert still.finding == "stands" and abs(still.response) < 0.1 and still.seconds == 10
    assert "only stands" in still.sentence() and "--policy.initial-std" in still.sentence()


def test_an_episode_counts_until_its_fall(agent, robot, monkeypatch):
    """Velocities after the end of an episode do not count, and half of the episodes decide."""
    steps, falls_at = diagnosis.STEPS, 100
    rollout = Locomotion.rollout

    def fallen(env, *args):
        state, episode = rollout(env, *args)
        terminated = np.zeros(np.shape(episode.terminated), bool)
        terminated[falls_at] = True
        privileged = np.array(episode.observation.privileged)
        general = np.array(episode.observation.general)
        general[..., 3:6] = 1.0
        privileged[:, :, :2] = 0.07  # 0.7 m/s of 1 m/s
        privileged[falls_at:, :, :2] = -1
        observation = types.SimpleNamespace(privileged=privileged, general=general)
        return state, types.SimpleNamespace(terminated=terminated, observation=observation)

    monkeypatch.setattr(Locomotion, "rollout", fallen)
    found = diagnose(agent.policy_config, agent.policy, robot)
    assert steps > falls_at and found.seconds == pytest.approx(0.02 * falls_at)
    assert found.finding == "falls" and found.response == pytest.approx(0.7, abs=1e-5)
    assert "end within 2.0 s" in found.sentence()


def test_a_run_says_it_until_the_robot_walks(capsys):
    report = progress.Progress(100, 1e9, True)
    for word in ("falls", "stands", "walks", "falls"):
        report.note(lambda word=word: Diagnosis("mini", word, 0.6, 1.0))
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[1].strip(":") for line in lines] == ["falls", "only", "walks"]
    progress.Progress(100, 1e9, False).note(lambda: pytest.fail("measured for nobody"))


def test_a_run_of_one_robot_is_diagnosed_once_it_can_tell(tmp_path, robot, monkeypatch):
    config = TrainConfig.smoke(str(robot.path))
    one = trainer.Trainer(config, tmp_path / "one")
    assert one.diagnosis() is None  # no steps yet
    monkeypatch.setattr(trainer, "TELLS_FROM", 0)
    assert one.diagnosis().robot == robot.name
    other = tiny_robot(tmp_path, legs=1)
    two = trainer.Trainer(
        replace(config, robots=(str(robot.path), str(other.path))), tmp_path / "two"
    )
    assert two.diagnosis() is None
