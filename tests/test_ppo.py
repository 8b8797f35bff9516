"""PPO: advantages, one update, exact resume, policy evaluation."""

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from tiny import tiny_robot

from shapebody.agent.store import load_agent, load_curve, save_agent
from shapebody.configuration import from_json, to_json
from shapebody.files import alone_in, data_dir
from shapebody.networks.config import CriticConfig
from shapebody.task.observations import Observation
from shapebody.training import chunks as chunks_of
from shapebody.training import config as training_config
from shapebody.training import (
    losses,
    policy_evaluation,
    progress,
    rollout,
    run_state,
    train,
)
from shapebody.training import trainer as training_trainer
from shapebody.training.update import init_learner, ppo_update

pytestmark = pytest.mark.usefixtures("quick")

RUN_FILES = run_state.STATE, run_state.PHASES, run_state.CURVE


def test_advantages_against_a_plain_loop():
    rng = np.random.default_rng(0)
    n, t, discount, lam = 5, 9, 0.99, 0.7
    reward, value = rng.normal(size=(2, n, t)).astype(np.float32)
    last = rng.normal(size=n).astype(np.float32)
    terminated = rng.random((n, t)) < 0.2
    truncated = rng.random((n, t)) < 0.2  # a fall counts, whatever else happens in its step
    assert np.any(terminated & truncated)
    got = losses.advantages(reward, value, last, terminated, truncated, discount, lam)
    for i in range(n):
        advantage = 0.0
        for k in reversed(range(t)):
            following = last[i] if k == t - 1 else value[i, k + 1]
            if truncated[i, k]:
                following = value[i, k]
            if terminated[i, k]:
                following = 0.0
            if truncated[i, k] or terminated[i, k]:
                advantage = 0.0
            advantage = (
                reward[i, k] + discount * following - value[i, k] + (discount * lam * advantage)
            )
            assert got[i, k] == pytest.approx(advantage, rel=1e-4, abs=1e-5)


def test_command_changes():
    command = np.zeros((2, 4, 13), np.float32)
    command[0, 2:, 4] = 0.5  # a new command in the third step
    command[1, :, 0] = np.arange(4)  # angular velocity changes in every step
    observation = Observation(joints=None, feet=None, general=command, privileged=None)
    last = replace(observation, general=np.array(command[:, -1]))
    changes = losses.command_changes(observation, last)
    np.testing.assert_array_equal(changes, [[False, True, False, False], [False] * 4])
    last.general[1, 5] = -0.1  # a new yaw rate after the last step
    assert losses.command_changes(observation, last)[1].tolist() == [False, False, False, True]


def test_losses_against_plain_loops():
    """The clipped surrogate, its weights and the value loss; steps that do not count may be NaN."""
    rng = np.random.default_rng(1)
    n, t, clip = 3, 4, 0.1
    new, old, behaviour, advantage = rng.normal(size=(4, n, t)).astype(np.float32)
    values = rng.normal(size=(n, t, 2)).astype(np.float32)
    target = rng.normal(size=(n, t)).astype(np.float32)
    valid = (rng.random((n, t)) < 0.7).astype(np.float32)
    count = valid.sum()
    surrogate = value = divergence = 0.0
    for i, k in np.argwhere(valid > 0):
        ratio = np.exp(new[i, k] - old[i, k])
        importance = min(np.exp(old[i, k] - behaviour[i, k]), 2.0)
        clipped = min(max(ratio, 1 - clip), 1 + clip)
        surrogate -= importance * min(ratio * advantage[i, k], clipped * advantage[i, k]) / count
        divergence += (ratio - 1 - np.log(ratio)) / count
        value += 0.5 * np.mean((values[i, k] - target[i, k]) ** 2) / count
    weight = losses.step_weights(valid)
    importance = losses.importance_weight(old, behaviour)
    new = np.where(valid > 0, new, np.float32("nan"))
    ratio, log_ratio = losses.policy_ratio(new, old, valid)
    got = losses.surrogate_loss(ratio, advantage, importance, weight, clip)
    assert got == pytest.approx(surrogate, rel=1e-5)
    assert losses.approximate_kl(ratio, log_ratio, weight) == pytest.approx(divergence, rel=1e-4)
    assert losses.value_loss(values, target, weight) == pytest.approx(value, rel=1e-5)
    outside = np.abs(np.asarray(ratio) - 1) > clip
    share = losses.clipped_share(ratio, weight, clip)
    assert share == pytest.approx(outside[valid > 0].mean(), rel=1e-5)
    mean, variance = losses.moments(losses.normalized(advantage, valid), valid)
    assert mean == pytest.approx(0, abs=1e-5) and variance == pytest.approx(1, rel=1e-4)
    std, mask = np.full((n, t, 2), 0.5, np.float32), np.array([1, 0], np.float32)
    expected = np.log(0.5) + 0.5 * np.log(2 * np.pi * np.e)
    assert losses.entropy_bonus(std, mask, weight) == pytest.approx(expected, rel=1e-5)
    assert losses.step_weights(np.zeros((n, t))).sum() == 0


def test_configurations():
    full = training_config.TrainConfig.full("unitree_go2")
    assert (full.num_envs, full.rollout_length, full.minibatch_size) == (4096, 64, 16384)
    assert full.learning_rate == (1.5e-3, 3e-4) and full.epochs == 10
    assert (full.discount, full.gae_lambda, full.clip_range) == (0.99, 0.7, 0.1)
    assert (full.entropy_coefficient, full.max_gradient_norm) == (0.005, 3.0)
    assert full.kl_threshold == 0.5 and full.total_steps == 10**9
    assert full.value_lambda is None and not full.cut_at_commands  # as the paper has it
    for size in (1000, 2 * full.batch):
        with pytest.raises(ValueError, match=f"minibatch_size is {size}"):
            replace(full, minibatch_size=size)
    with pytest.raises(ValueError, match="mean_actions is True, but a policy learns"):
        replace(full, mean_actions=True)
    for environments in (7_680, 15_040):  # the paper's other runs
        assert replace(full, num_envs=environments).minibatch_size == 16_384
    with pytest.raises(ValueError, match="scale is 'huge'"):
        training_config.TrainConfig.at_scale("huge", "unitree_go2")


@pytest.mark.parametrize(
    "name, value",
    [
        ("robots", ()),
        ("robots", ("a/legs.xml", "b/legs.xml")),
        ("robots", ("unitree_go2", "unitree_go2")),
        ("seed", -1),
        ("seed", 1.0),
        ("num_envs", -256),
        ("rollout_length", 0),
        ("total_steps", 0),
        ("total_steps", 5e7),
        ("minibatch_size", 0),
        ("epochs", 0),
        ("state_bank", 0),
        ("discount", 2.0),
        ("discount", True),
        ("gae_lambda", 7),
        ("gae_lambda", None),
        ("value_lambda", 1.5),
        ("value_lambda", float("nan")),
        ("clip_range", 0.0),
        ("clip_range", float("inf")),
        ("entropy_coefficient", -0.1),
        ("entropy_coefficient", "none"),
        ("max_gradient_norm", 0),
        ("kl_threshold", 0.0),
        ("kl_threshold", float("nan")),
        ("learning_rate", 4e-4),
        ("learning_rate", (4e-4,)),
        ("learning_rate", (4e-4, -1e-4)),
        ("learning_rate", (4e-4, float("inf"))),
    ],
)
def test_configurations_without_sense(name, value):
    with pytest.raises(ValueError, match=f"{name} is .*; expected"):
        training_config.TrainConfig.reduced("unitree_go2", **{name: value})


@pytest.mark.parametrize(
    "name, value",
    [("policy", {}), ("critic", None), ("task", None), ("standardize", "yes"), ("seed", 1.5)],
)
def test_configurations_of_wrong_kinds(name, value):
    with pytest.raises((TypeError, ValueError), match=f"{name} is .*; expected"):
        training_config.TrainConfig.reduced("unitree_go2", **{name: value})
    with pytest.raises(ValueError, match="scale is 'huge'; expected .*smoke"):
        training_config.TrainConfig.reduced("unitree_go2", scale="huge")


def test_robots_may_be_paths():
    config = training_config.TrainConfig.reduced(Path("here") / "bolt.xml")
    assert config.robots == (str(Path("here") / "bolt.xml"),) and config.name == "bolt"


@pytest.fixture(scope="module")
def config():
    return training_config.TrainConfig.smoke("unitree_go2", total_steps=128 * 5)


def begin(config, folder, engine="auto"):
    """A trainer whose bodies differ, since it begins at c = 0.5; or the one to be continued."""
    trainer = training_trainer.Trainer(config, folder, engine)
    if not trainer.start():
        trainer.actor.reset(coefficient=0.5)
    return trainer


@pytest.fixture(scope="module")
def straight(config, tmp_path_factory):
    folder = tmp_path_factory.mktemp("straight")
    trainer = begin(config, folder)
    trainer.run(max_steps=128 * 4, progress=False)
    return folder, trainer


def leaves(trainer):
    return [np.asarray(x) for x in jax.tree.leaves(trainer.learner)]


def test_resume_is_exact(config, straight, tmp_path):
    """Stopped twice, the run ends with the very weights of the uninterrupted one."""
    for steps in (128, 128 * 3, 128 * 4):
        trainer = begin(config, tmp_path)
        trainer.run(max_steps=steps, progress=False)
        assert trainer.steps == steps
    designs = np.asarray(trainer.actor.state.design)
    assert np.all(np.abs(designs).max(1) > 0.3) and np.all(np.std(designs, 0)[:100] > 0.1)
    for a, b in zip(leaves(straight[1]), leaves(trainer), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_run_goes_on_in_the_same_process(config, straight, tmp_path):
    trainer = begin(config, tmp_path)
    trainer.run(max_steps=128, progress=False)
    trainer.state_bank(rollouts=1)  # uses the same engine
    trainer.run(max_steps=128 * 4, progress=False)
    for a, b in zip(leaves(straight[1]), leaves(trainer), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_crash_while_saving_loses_nothing(config, straight, tmp_path, monkeypatch):
    trainer = training_trainer.Trainer(config, tmp_path)
    trainer.start()
    trainer.run(max_steps=128, progress=False)
    before = (tmp_path / "training.safetensors").read_bytes()

    def fail(*args, **kwargs):
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match="disk full"):
        trainer.run(max_steps=256, progress=False)
    monkeypatch.undo()
    assert (tmp_path / "training.safetensors").read_bytes() == before
    again = training_trainer.Trainer(config, tmp_path)
    assert again.start() and again.steps == 128


def test_an_interrupt_saves_an_agent_only_after_an_iteration(config, tmp_path, monkeypatch, capsys):
    with pytest.raises(ValueError, match="max_steps is 127; one iteration is 128 steps"):
        train.train(config, tmp_path / "none", max_steps=127)
    assert not (tmp_path / "none").exists()

    def interrupt(*args):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(rollout.Actor, "_collect", interrupt)
        train.train(config, tmp_path)
    assert capsys.readouterr().out.endswith("before the first iteration: nothing was saved\n")
    assert not list(tmp_path.glob("agent.json")) + list(tmp_path.glob("*.safetensors"))
    # In the third iteration, after the update and before the state is saved.
    save = training_trainer.Trainer.save
    monkeypatch.setattr(
        training_trainer.Trainer, "save", lambda t: interrupt() if t.steps > 256 else save(t)
    )
    agent = train.train(config, tmp_path)
    assert capsys.readouterr().out.endswith("interrupted: saved, the same call continues\n")
    assert agent.metadata["steps"] == 256 and load_agent(tmp_path).hash == agent.hash
    monkeypatch.undo()
    # The agent is that of the run as it is on disk, so the same call continues.
    agent = train.train(config, tmp_path, progress=False, max_steps=384)
    assert agent.metadata["steps"] == 384


def test_an_interrupt_of_the_last_step_says_what_is_saved(config, tmp_path, monkeypatch, capsys):
    def interrupt(trainer, folder=None):
        raise KeyboardInterrupt

    with monkeypatch.context() as context:
        context.setattr("shapebody.training.trainer.Trainer.save_agent", interrupt)
        with pytest.raises(KeyboardInterrupt):
            train.train(config, tmp_path, max_steps=config.batch)
    assert "the run is saved, the agent is not: the same call saves it" in capsys.readouterr().out
    assert (
        train.train(config, tmp_path, False, max_steps=config.batch).metadata["steps"]
        == config.batch
    )


def test_an_agent_is_not_replaced_by_one_with_fewer_steps(config, tmp_path):
    config = replace(config, num_envs=8, minibatch_size=32, epochs=1)
    description = tmp_path / "agent.json"
    description.write_text('{"metadata": {"steps": 34000}}')
    arguments = dict(folder=tmp_path, progress=False)
    with pytest.raises(ValueError, match=r"34,000 steps.* it 0;.*replace=True.*state_only=True"):
        train.train(config, **arguments)
    assert train.train(config, max_steps=64, state_only=True, **arguments) is None
    with pytest.raises(ValueError, match=r"34,000 steps.* it 64;"):
        train.train(config, **arguments)
    assert "34000" in description.read_text()
    agent = train.train(config, max_steps=128, replace=True, **arguments)
    assert load_agent(tmp_path).hash == agent.hash


def test_a_call_that_trains_nothing_leaves_the_agent(config, tmp_path, monkeypatch):
    config = replace(config, num_envs=8, minibatch_size=32, epochs=1)
    arguments = dict(folder=tmp_path, progress=False, max_steps=64)
    trainer = training_trainer.Trainer(config, tmp_path)
    monkeypatch.setattr("shapebody.training.train.Trainer", lambda *_: trainer)  # compiled once
    agent = train.train(config, **arguments)
    # Another critic, as train_critic saves it; then an agent of more steps, as anneal does.
    critic = jax.tree.map(lambda x: x + 1, agent.critic)
    for steps in (64, 128):
        metadata = {**agent.metadata, "steps": steps, "policy_evaluation": {}}
        save_agent(replace(agent, critic=critic, metadata=metadata), tmp_path)
        files = {file: file.read_bytes() for file in tmp_path.iterdir()}
        again = train.train(config, **arguments)
        assert again.hash == load_agent(tmp_path).hash != agent.hash
        assert again.metadata["steps"] == steps and "policy_evaluation" in again.metadata
        assert {file: file.read_bytes() for file in tmp_path.iterdir()} == files
    # Nor is an agent with such a critic replaced by a call that trains.
    arguments["max_steps"] = 192
    save_agent(replace(again, metadata=again.metadata | {"steps": 64}), tmp_path)
    with pytest.raises(ValueError, match="critic from policy evaluation.*--state-only"):
        train.train(config, **arguments)
    assert load_agent(tmp_path).hash == again.hash
    arguments["max_steps"] = 64
    assert train.train(config, replace=True, **arguments).hash == load_agent(tmp_path).hash
    assert "policy_evaluation" not in load_agent(tmp_path).metadata
    # An agent that is behind the run is brought up to it.
    train.train(config, state_only=True, **arguments | {"max_steps": 128})
    assert train.train(config, **arguments | {"max_steps": 128}).metadata["steps"] == 128


def test_a_run_keeps_its_engine(config, straight, tmp_path, monkeypatch):
    assert straight[1].phases[0]["engine"] == "native"
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert training_trainer.Trainer(config, straight[0]).env.engine == "native"
    with pytest.raises(ValueError, match="engine is 'mjx', but the run in .* with 'native'"):
        training_trainer.Trainer(config, straight[0], "mjx")
    with pytest.raises(ValueError, match="engine is 'mjx'"):
        train.anneal(straight[0], engine="mjx")
    assert run_state.run_engine(tmp_path, "mjx") == "mjx"
    (tmp_path / "training.safetensors").touch()
    for phases, own in [("[{}]", "native"), ('[{"engine": "mjx"}, {}]', "mjx"), ("{", "auto")]:
        (tmp_path / "training.json").write_text(phases)
        assert run_state.run_engine(tmp_path, "auto") == own
    assert run_state.run_engine(tmp_path, "mjx") == "mjx"


def test_a_run_continues_only_with_its_own_configuration(config, tmp_path):
    trainer = training_trainer.Trainer(config, tmp_path)
    trainer.start()
    trainer.run(max_steps=128, progress=False)
    for changes, message in (
        (dict(discount=0.9), "discount was 0.99, is 0.9"),
        (dict(epochs=1, total_steps=1280), r"total_steps was 640, is 1280; epochs was 2, is 1\)"),
        (dict(policy=replace(config.policy, latent_scale=3.0)), "policy.latent_scale was 1.0, is"),
        (dict(task=replace(config.task, push_probability=0.5)), "task.push_probability was 0.002,"),
        # The setting is named even where the arrays have other shapes.
        (
            dict(policy=replace(config.policy, core_widths=(12, 8))),
            r"core_widths was \[16, 8\], is \[12, 8\]",
        ),
        (dict(num_envs=32), "num_envs was 16, is 32.*continue_run.*choose another name"),
    ):
        with pytest.raises(ValueError, match=message):
            training_trainer.Trainer(replace(config, **changes), tmp_path).start()
    # A run that is older than a setting goes on with the setting's default.
    path = tmp_path / "training.json"
    phases = json.loads(path.read_text())
    del phases[0]["config"]["task"]["design_radius"]
    path.write_text(json.dumps(phases))
    assert trainer.start()
    trainer.phases[0]["robots"]["unitree_go2"] = "another file"
    trainer.save()
    with pytest.raises(ValueError, match="file of robot unitree_go2 has changed"):
        trainer.start()
    path.write_text("{")
    with pytest.raises(ValueError, match="training.json is missing or damaged"):
        trainer.start()


def test_a_run_goes_on_with_what_it_has(config, tmp_path):
    """Whatever the defaults are now; settings are overridden by name, and that is recorded."""
    config = replace(config, num_envs=8, minibatch_size=32, epochs=1, name="walker")
    arguments = dict(progress=False, state_only=True)
    with pytest.raises(FileNotFoundError, match="there is no run in .*training.safetensors"):
        train.continue_run(tmp_path, **arguments)
    train.train(config, tmp_path, max_steps=64, **arguments)
    train.continue_run(tmp_path, max_steps=128, **arguments)
    path = tmp_path / "training.json"
    assert [phase["from_step"] for phase in json.loads(path.read_text())] == [0]
    for overrides, message in (
        (dict(num_envs=16), "overrides has 'num_envs'; expected settings .*epochs"),
        (dict(discount=2.0), "discount is 2.0; expected a probability"),
        (dict(robots=("golem",)), "robots was .*unitree_go2.*, is .*golem"),
        (dict(policy=replace(config.policy, core_widths=(12, 8))), "does not fit the state"),
    ):
        with pytest.raises(ValueError, match=message):
            train.continue_run(tmp_path, overrides, **arguments)
    # The limits of the noise and the lengths of episodes fit any state.
    overrides = dict(
        policy=replace(config.policy, std_limits=(0.05, 2.0)),
        task=replace(config.task, horizon=6, curriculum_length=3),
        learning_rate=(1e-4, 1e-4),
    )
    train.continue_run(tmp_path, overrides, max_steps=320, **arguments)
    phases = json.loads(path.read_text())
    assert [phase["from_step"] for phase in phases] == [0, 128]
    assert phases[1]["config"]["learning_rate"] == [1e-4, 1e-4]
    changed = replace(config, **overrides)
    assert run_state.read_config(tmp_path) == changed
    trainer = training_trainer.Trainer(changed, tmp_path)
    assert trainer.start() and 6 in np.asarray(trainer.actor.state.horizon)
    with pytest.raises(ValueError, match="learning_rate was .*; policy.std_limits was|policy.std"):
        train.train(config, tmp_path, **arguments)
    train.train(changed, tmp_path, max_steps=384, **arguments)
    assert json.loads(path.read_text()) == phases


@pytest.mark.parametrize("name", ["unitree_go2", "mit_humanoid", "golem"])
def test_shipped_runs_have_one_configuration(name):
    """Their training.json has several phases, of which the last one counts."""
    folder = data_dir() / "checkpoints" / name
    config = run_state.read_config(folder)
    steps = run_state.finished_iterations(folder) * config.batch
    robot = SimpleNamespace(name=name, hash=run_state.read_phases(folder)[0]["robots"][name])
    phases = run_state.continued_phases(folder, config, steps, [robot])
    assert len(phases) > 1 and phases == run_state.read_phases(folder)
    assert config != training_config.TrainConfig.reduced(name)
    with pytest.raises(ValueError, match="has another configuration"):
        run_state.continued_phases(
            folder, training_config.TrainConfig.reduced(name), steps, [robot]
        )


@pytest.mark.parametrize("call", [train.train, training_config.TrainConfig.reduced])
def test_what_is_no_configuration_and_no_robot(call):
    with pytest.raises(TypeError, match="expected a"):
        call(SimpleNamespace(name="go2"))


def test_two_runs_in_one_folder(config, tmp_path):
    trainer = training_trainer.Trainer(config, tmp_path)
    trainer.start()
    with alone_in(tmp_path), pytest.raises(ValueError, match="another training run is at work in"):
        trainer.run(max_steps=config.batch, progress=False)
    assert list(tmp_path.iterdir()) == []
    trainer.run(max_steps=config.batch, progress=False)  # free again
    assert trainer.steps == config.batch


def test_annealing_leaves_the_run_as_it_is(config, tmp_path, monkeypatch):
    config = replace(config, num_envs=8, minibatch_size=32, epochs=1, name="walker")
    with pytest.raises(ValueError, match="training.safetensors is missing"):
        train.anneal(tmp_path)
    trainer = training_trainer.Trainer(config, tmp_path)
    trainer.start()
    trainer.run(max_steps=2 * config.batch, progress=False)
    before = {file: (tmp_path / file).read_bytes() for file in RUN_FILES}
    rate = np.interp(2 / config.iterations, [0, 1], config.learning_rate)

    steps, last_rate = 3 * config.batch, 1e-6
    # A time limit stops it early; the same call goes on with what is left.
    arguments = dict(steps=steps, last_rate=last_rate, progress=False)
    assert train.anneal(tmp_path, max_seconds=0.0, **arguments) is None
    with pytest.raises(ValueError, match="delete that folder to begin anew"):
        train.anneal(tmp_path, **arguments | {"steps": 2 * config.batch})
    assert not (tmp_path / "agent.json").exists()
    agent = train.anneal(tmp_path, **arguments)
    assert agent.metadata["steps"] == 5 * config.batch
    assert load_agent(tmp_path).hash == agent.hash
    assert {file: (tmp_path / file).read_bytes() for file in RUN_FILES} == before
    assert not (tmp_path / "annealed").exists()
    phase = agent.metadata["phases"][-1]
    first, last = phase["config"]["learning_rate"]
    assert (phase["from_step"], last) == (2 * config.batch, last_rate)
    assert np.interp(2 / 5, [0, 1], [first, last]) == pytest.approx(rate)
    rows = load_curve(tmp_path)
    assert rows["steps"][-1] == 5 * config.batch
    with pytest.raises(ValueError, match="agent .* has 320 steps, the run that would .* it 192"):
        train.anneal(tmp_path, **arguments | {"steps": config.batch})
    with pytest.raises(ValueError, match="last_rate is 0.01, above the present rate"):
        train.anneal(tmp_path, **arguments | {"last_rate": 1e-2})
    for steps in (0, -5, 1.5):
        with pytest.raises(ValueError, match=f"steps is {steps}; expected an integer of at least"):
            train.anneal(tmp_path, **arguments | {"steps": steps})
    document = json.loads((tmp_path / "agent.json").read_text())
    document["metadata"]["policy_evaluation"] = {}
    (tmp_path / "agent.json").write_text(json.dumps(document))
    with pytest.raises(ValueError, match="critic from policy evaluation"):
        train.anneal(tmp_path, **arguments | {"steps": 9 * config.batch})
    assert not (tmp_path / "annealed").exists() and load_agent(tmp_path).hash == agent.hash
    arguments |= {"steps": 2 * config.batch, "replace": True}
    assert train.anneal(tmp_path, max_seconds=0.0, **arguments) is None
    assert (tmp_path / "annealed" / "training.safetensors").exists()


def test_environments_that_fill_no_minibatch_wait_for_another_epoch(config, tmp_path):
    config = replace(config, num_envs=10, minibatch_size=32, epochs=3)  # 4 environments in each
    trainer = training_trainer.Trainer(config, tmp_path)
    trainer.start()
    trainer.run(max_steps=config.batch, progress=False)
    counts = optax.tree.get_all_with_path(trainer.learner.policy_optimizer, "count")
    assert [int(count) for _, count in counts] == [3 * 2]


def test_state_only_saves_no_agent(config, tmp_path):
    config = replace(config, num_envs=8, minibatch_size=32, epochs=1)
    arguments = dict(folder=tmp_path, progress=False, state_only=True)
    assert train.train(config, max_steps=config.batch, **arguments) is None
    assert (tmp_path / "training.safetensors").exists() and not (tmp_path / "agent.json").exists()


def test_configurations_read_back_from_json():
    for config in (
        training_config.TrainConfig.full("unitree_go2"),
        training_config.TrainConfig.smoke("golem", seed=3),
    ):
        assert from_json(training_config.TrainConfig, to_json(config)) == config
    endless = replace(config, kl_threshold=float("inf"))
    text = json.dumps(to_json(endless), allow_nan=False)  # as in the metadata of an agent
    assert from_json(training_config.TrainConfig, json.loads(text)) == endless


def test_names_of_agents():
    assert training_config.TrainConfig.reduced("some/where/my_robot.xml").name == "my_robot"
    several = training_config.TrainConfig.reduced("a", robots=("a", "b/c.xml"))
    assert several.name == "a+c" and several.robots == ("a", "b/c.xml")
    with pytest.raises(ValueError, match="without separators"):
        training_config.TrainConfig.reduced("a", name="b/c")


def test_a_broken_minibatch_changes_nothing(straight):
    _, trainer = straight
    env = trainer.env
    state = env.reset(jax.random.PRNGKey(1), coefficient=0.0)
    _, trajectory = env.rollout(
        trainer.actor.act, trainer.learner.policy, state, jax.random.PRNGKey(2), 8
    )
    trajectory = replace(trajectory, reward=np.full_like(trajectory.reward, np.nan))
    after, _ = ppo_update(trainer.config, trainer.learner, trajectory, jax.random.PRNGKey(3))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(after))


def test_update_follows_the_advantage(straight):
    """Actions with positive advantage become more likely, and the critic fits its targets."""
    _, trainer = straight
    env, config = trainer.env, replace(trainer.config, epochs=8, entropy_coefficient=0.0)
    learner = init_learner(config, trainer.learner.policy, trainer.learner.critic)
    state = env.reset(jax.random.PRNGKey(1), coefficient=0.0)
    state, trajectory = env.rollout(
        trainer.actor.act, learner.policy, state, jax.random.PRNGKey(2), 8
    )
    # Reward actions of the first joint by their sign.
    sign = np.sign(np.asarray(trajectory.action)[..., 0])
    trajectory = replace(trajectory, reward=sign.astype(np.float32))
    after, metrics = ppo_update(config, learner, trajectory, jax.random.PRNGKey(3))

    def mean_action(policy):
        mean, _ = trainer.policy.apply(policy, state.descriptions, trajectory.last_observation)
        return float(jnp.mean(mean[:, 0]))

    assert mean_action(after.policy) > mean_action(learner.policy)
    assert metrics["updates"] > 0 and 0 < metrics["kl"] < 0.5
    later = after
    for i in range(5):
        later, more = ppo_update(config, later, trajectory, jax.random.PRNGKey(4 + i))
    assert more["value_loss"] < metrics["value_loss"]


def test_advantages_end_where_the_command_changes(straight):
    """What a new command is worth reaches the critic's targets, but not the policy's advantages."""
    _, trainer = straight
    state = trainer.env.reset(jax.random.PRNGKey(1), coefficient=0.0)
    learner, key = trainer.learner, jax.random.PRNGKey(2)
    state, trajectory = trainer.env.rollout(trainer.actor.act, learner.policy, state, key, 8)
    general = np.array(trajectory.observation.general)
    general[4:, :, 3:6] = general[:4, :, 3:6] + 0.5
    after = replace(
        trajectory,
        observation=replace(trajectory.observation, general=general),
        last_observation=replace(trajectory.last_observation, general=general[-1]),
        reward=np.zeros_like(trajectory.reward),
    )
    # The policy learns from the steps before the change alone; rewards come after it.
    early = np.arange(8)[:, None] < 4
    after = replace(after, valid=np.asarray(after.valid) * early)
    late = replace(after, reward=np.where(early, after.reward, np.float32(1)))

    def learn(trajectory, **changes):
        config = replace(trainer.config, epochs=1, entropy_coefficient=0.0, **changes)
        fresh = init_learner(config, learner.policy, learner.critic)
        new, _ = ppo_update(config, fresh, trajectory, jax.random.PRNGKey(3))
        return [
            np.concatenate([np.ravel(x) for x in jax.tree.leaves(variables)])
            for variables in (new.policy, new.critic)
        ]

    (policy, critic), (late_policy, late_critic) = learn(after), learn(late)
    np.testing.assert_array_equal(policy, late_policy)
    assert np.any(critic != late_critic)
    whole, late_whole = (learn(t, cut_at_commands=False)[0] for t in (after, late))
    assert np.any(whole != late_whole)
    # The next episode after a fall has another command too, and that is not a reason to spare it.
    ended = np.asarray(after.terminated).copy()
    ended[3] = True
    fall = replace(after, terminated=ended, truncated=np.zeros_like(ended))
    np.testing.assert_array_equal(learn(fall)[0], learn(fall, cut_at_commands=False)[0])
    assert np.any(learn(fall)[0] != policy)


def test_the_critic_has_a_lambda_of_its_own(straight):
    _, trainer = straight
    state = trainer.env.reset(jax.random.PRNGKey(1), coefficient=0.0)
    learner = trainer.learner
    _, trajectory = trainer.env.rollout(
        trainer.actor.act, learner.policy, state, jax.random.key(2), 8
    )

    def learn(value_lambda, gae_lambda):
        config = replace(trainer.config, epochs=1, value_lambda=value_lambda, gae_lambda=gae_lambda)
        fresh = init_learner(config, learner.policy, learner.critic)
        new, _ = ppo_update(config, fresh, trajectory, jax.random.PRNGKey(3))
        return [
            np.concatenate([np.ravel(x) for x in jax.tree.leaves(v)])
            for v in (new.policy, new.critic)
        ]

    policy, critic = learn(0.95, 0.7)
    other_policy, other_critic = learn(0.0, 0.7)
    np.testing.assert_array_equal(policy, other_policy)
    assert np.any(critic != other_critic)
    np.testing.assert_array_equal(critic, learn(0.95, 0.2)[1])
    np.testing.assert_array_equal(learn(None, 0.7)[1], learn(0.7, 0.7)[1])


def test_curve_has_a_row_per_interval(config, tmp_path, monkeypatch):
    monkeypatch.setattr("shapebody.training.trainer.CURVE_INTERVAL", 2)
    for steps in (128 * 2, 128 * 5):
        trainer = training_trainer.Trainer(config, tmp_path)
        trainer.start()
        trainer.run(max_steps=steps, progress=False)
    rows = (tmp_path / "training.csv").read_text().splitlines()
    assert rows[0].split(",") == progress.CURVE
    assert [int(row.split(",")[0]) for row in rows[1:]] == [256, 512, 640]


def test_speed_does_not_count_compilation(tmp_path):
    rollout = SimpleNamespace(
        terminated=np.zeros((2, 2), bool),
        truncated=np.zeros((2, 2), bool),
        finite=np.ones((2, 2), bool),
    )
    for name in ("episode_return", "episode_length", "episode_error", "coefficient", "reward"):
        setattr(rollout, name, np.zeros((2, 2)))
    curve = progress.Curve(tmp_path / "training.csv", 0)
    curve.add(rollout, {}, 100, None)
    assert "steps_per_second" not in curve.latest
    curve.add(rollout, {}, 100, 0.5)
    assert curve.latest["steps_per_second"] == 200
    curve.write(200, 60.5)
    assert progress.read_rows(curve.path)[0][0]["steps_per_second"] == "200"


def test_a_row_that_was_cut_off_leaves_the_curve(tmp_path):
    path = tmp_path / "training.csv"
    cells = ["128", "1.5", "", *["0.25"] * (len(progress.CURVE) - 3)]  # no episode has ended
    header, first, last = (
        ",".join(row) + "\n" for row in (progress.CURVE, cells, ["256", *cells[1:]])
    )
    # Within the steps, after some cells, within the last number, and with the next row behind it.
    for torn in ("2", "256,1.5,", last[:-2], last[:-1], "", last[:9] + last):
        path.write_text(header + first + torn)
        progress.Curve(path, steps=256)
        assert path.read_text() == header + first, torn
    path.write_text(header + first + last)
    progress.Curve(path, steps=256)
    assert path.read_text() == header + first + last
    progress.Curve(path, steps=128)
    assert path.read_text() == header + first


def test_train_and_policy_evaluation(config, tmp_path):
    agent = train.train(config, tmp_path / "a", progress=False, max_steps=128)
    loaded = load_agent(tmp_path / "a")
    curve = (tmp_path / "a" / "curve.csv").read_text()
    assert curve.splitlines()[-1].startswith("128,")
    assert curve == (tmp_path / "a" / "training.csv").read_text()
    # Training on does not touch the agent or its curve until the agent is saved.
    trainer = training_trainer.Trainer(config, tmp_path / "a")
    trainer.start()
    trainer.run(max_steps=256, progress=False)
    assert (tmp_path / "a" / "training.csv").read_text().splitlines()[-1].startswith("256,")
    assert (tmp_path / "a" / "curve.csv").read_text() == curve
    assert load_agent(tmp_path / "a").hash == loaded.hash
    assert loaded.metadata["steps"] == 128 and loaded.robots == ("unitree_go2",)
    assert agent.states.joints.shape == (64, 12, 4)
    small = CriticConfig.reduced(
        joint_key_widths=(8, 8), foot_key_widths=(8, 8), head_widths=(8,), heads=3
    )
    # A phase that is stopped leaves the agent as it is; the same call goes on with it.
    arguments = dict(steps=256, folder=tmp_path / "b", progress=False)
    save_agent(loaded, tmp_path / "b")
    assert policy_evaluation.train_critic(loaded, small, max_seconds=0.0, **arguments) is loaded
    assert load_agent(tmp_path / "b").hash == loaded.hash
    sharper = policy_evaluation.train_critic(loaded, small, **arguments)
    assert len(list((tmp_path / "b").glob("critic_*"))) == 1
    assert load_agent(tmp_path / "b").hash == sharper.hash != loaded.hash
    assert sharper.policy_hash == loaded.policy_hash
    again = policy_evaluation.train_critic(sharper, small, **arguments)
    assert again.hash == sharper.hash
    longer = policy_evaluation.train_critic(sharper, small, **arguments | {"steps": 384})
    assert longer.metadata["policy_evaluation"]["steps"] == 384
    for a, b in zip(jax.tree.leaves(agent.policy), jax.tree.leaves(sharper.policy), strict=True):
        np.testing.assert_array_equal(a, b)
    assert sharper.critic_config.heads == 3 and sharper.metadata["steps"] == 128
    phase = sharper.metadata["policy_evaluation"]
    assert phase["steps"] == 256
    assert phase["config"]["task"]["design_radius"] == [0.0, 1.0]
    assert phase["config"]["task"]["horizon"] == 200
    assert phase["config"]["mean_actions"] and phase["config"]["epochs"] == 1
    assert np.all(np.asarray(sharper.states.privileged)[:, 4] == 1.0)


def test_mean_actions_are_without_noise(config, tmp_path):
    """The first ones of a rollout do not depend on its random key."""
    config = replace(config, learn_policy=False)
    for mean_actions in (True, False):
        trainer = training_trainer.Trainer(replace(config, mean_actions=mean_actions), tmp_path)
        first = []
        for key in jax.random.split(trainer.key):
            state = trainer.env.reset(trainer.key, coefficient=1.0)
            arguments = trainer.actor.act, trainer.learner.policy, state, key, config.rollout_length
            first.append(np.asarray(trainer.env.rollout(*arguments)[1].action)[0])
        assert np.all((first[0] == first[1]) == mean_actions)


@pytest.mark.parametrize("terminal", [True, False])
def test_progress_counts_from_the_second_iteration(capsys, monkeypatch, terminal):
    monkeypatch.setattr("sys.stdout.isatty", lambda: terminal, raising=False)
    now = [1000.0]
    for name in ("time.monotonic", "tqdm.std.time"):
        monkeypatch.setattr(name, lambda: now[0])

    def shown(last, seconds):
        curve = SimpleNamespace(latest=dict(coefficient=0.0))
        now[0] += 1000
        with progress.Progress(last, now[0] + seconds, True) as report:
            now[0] += 300  # compilation
            report.show(4_000, curve)
            for steps in range(5_000, 9_000, 1_000):
                now[0] += 10
                report.show(steps, curve)
        return capsys.readouterr().out

    out = shown(68_000, math.inf)
    assert out.rstrip().endswith(
        "8,000 steps  no episode has ended yet  c 0.00  100 steps/s  10:00 left"
    )
    assert ("\r" in out) == terminal
    timed = shown(68_000, 460)
    assert "02:00 left" in timed and ("25%" in timed) == terminal  # of the time, not of the steps
    assert "00:00 left" in shown(68_000, 0)
    lines = shown(68_000, math.inf).strip().splitlines()
    assert terminal or len(lines) == 2  # at most one a minute, and one at the end


def test_compilation_is_announced(capsys):
    progress.announce("auto", 1, False)
    assert not capsys.readouterr().out
    progress.announce("native", 5, True)
    assert capsys.readouterr().out.startswith("compiling, about ")


@pytest.mark.slow
def test_training_on_mjx_resumes(tmp_path):
    """The run that was stopped ends with the very weights of the uninterrupted one."""
    config = training_config.TrainConfig.smoke("unitree_go2", num_envs=4, minibatch_size=32)
    straight = begin(config, tmp_path / "straight", "mjx")
    straight.run(max_steps=96, progress=False)
    for steps in (32, 96):
        trainer = begin(config, tmp_path / "stopped", "mjx" if steps == 32 else "auto")
        assert trainer.env.engine == "mjx"
        trainer.run(max_steps=steps, progress=False)
    assert trainer.steps == 96 and np.any(np.asarray(trainer.actor.state.design))
    for a, b in zip(leaves(straight), leaves(trainer), strict=True):
        np.testing.assert_array_equal(a, b)


def test_chunks_change_nothing_but_the_order_of_sums():
    """Of arrays without numbers, too: a robot may have no collision spheres."""
    x = {"a": np.arange(24.0, dtype=np.float32).reshape(6, 4), "none": np.zeros((6, 2, 0))}

    def double(part):
        return {"a": 2 * part["a"], "none": part["none"]}

    def total(part):
        return part["a"].sum(0)

    for chunks in (1, 2, 3, 6):
        mapped = chunks_of.mapped(double, x, chunks)
        np.testing.assert_array_equal(mapped["a"], 2 * x["a"])
        assert mapped["none"].shape == (6, 2, 0)
        np.testing.assert_allclose(chunks_of.summed(total, x, chunks), x["a"].sum(0))
    assert chunks_of.number_of_chunks(256, 32) == 8 and chunks_of.number_of_chunks(3, 8) == 1
    assert chunks_of.number_of_chunks(6 * 7, 1024) == 42


def test_a_robot_without_collision_spheres_learns(tmp_path):
    text = tiny_robot(tmp_path).path.read_text()
    bare = text.replace('<geom name="sphere_0" type="sphere" size="0.08" group="5"/>', "")
    assert bare != text
    (tmp_path / "bare.xml").write_text(bare)
    config = training_config.TrainConfig.smoke(
        str(tmp_path / "bare.xml"), num_envs=64, rollout_length=32, minibatch_size=2048
    )
    assert chunks_of.number_of_chunks(64, 32) == 2
    trainer = training_trainer.Trainer(config, tmp_path / "run")
    trainer.start()
    trainer.run(max_steps=config.batch, progress=False)
    assert trainer.env.sizes.spheres == 0 and trainer.steps == config.batch
