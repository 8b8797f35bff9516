"""Many critics on the same rollouts, and agents without a critic."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from test_networks import published_layers, write_published

from shapebody.agent.published import load_published_policy
from shapebody.agent.store import load_agent, save_agent
from shapebody.evaluation.evaluate import evaluate
from shapebody.networks.config import CriticConfig
from shapebody.optimizers.search import search
from shapebody.reproduction import critic_ablation
from shapebody.training.critics import held_out_scores, train_critics
from shapebody.training.policy_evaluation import train_critic

pytestmark = pytest.mark.usefixtures("quick")

SMALL = CriticConfig.reduced(heads=1, joint_value_latent=4, head_widths=(8,))
OTHER = dataclasses.replace(SMALL, kind="original")
RUN = dict(num_envs=4, rollout_length=8, minibatch_size=16, state_bank=16)


@pytest.fixture(scope="module")
def published(robot, tmp_path_factory):
    folder = tmp_path_factory.mktemp("published")
    write_published(folder, published_layers(), "legs_2")
    return load_published_policy(folder, robots=[robot])


def weights(agent):
    return jax.tree.leaves((agent.policy, agent.critic))


def test_a_published_policy_walks_but_does_not_judge(published, robot, tmp_path):
    assert published.robots == (robot.name,) and published.critic is None
    assert evaluate(published, robot, np.zeros(robot.design_dim, "f4"), episodes=1).returns.size
    with pytest.raises(ValueError, match="has no critic.*train_critics"):
        search("vgds", published, robot, np.zeros(robot.design_dim, "f4"))
    with pytest.raises(ValueError, match="has no critic"):
        save_agent(published, tmp_path)


@pytest.mark.parametrize(
    "layers",
    [
        None,
        {},
        ["x"],
        [{"name": "Dense_0.kernel"}],
        [{"name": "a", "shape": [-1], "offset": 0, "size_bytes": 4}],
    ],
)
def test_other_formats_are_refused(tmp_path, layers):
    (tmp_path / "a.weights.json").write_text(json.dumps({"layers": layers}))
    (tmp_path / "a.weights.bin").write_bytes(bytes(8))
    with pytest.raises(ValueError, match="no published policy"):
        load_published_policy(tmp_path)


@pytest.mark.parametrize("wrong", [5, {"softmax_temperature": "hot"}])
def test_other_hyperparameters_are_refused(tmp_path, wrong):
    write_published(tmp_path, published_layers(), "a")
    path = tmp_path / "a.weights.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"hyperparams": wrong}))
    with pytest.raises(ValueError, match="softmax_temperature in .* expected a number"):
        load_published_policy(tmp_path)


def test_each_critic_learns_as_if_it_were_alone(published, tmp_path):
    """And a run that was stopped ends with the same weights."""
    critics, steps = {"small": SMALL, "other": OTHER}, 32 * 3
    both = train_critics(published, critics, tmp_path / "both", steps, 2, False, **RUN)
    assert list(both) == [f"{name}, seed {seed}" for name in critics for seed in (0, 1)]
    alone = train_critics(published, {"other": OTHER}, tmp_path / "alone", steps, 2, False, **RUN)
    for seed in (0, 1):
        for one, two in zip(
            weights(both[f"other, seed {seed}"]), weights(alone[f"other, seed {seed}"]), strict=True
        ):
            np.testing.assert_array_equal(one, two)
    first, second = (weights(both[f"small, seed {seed}"]) for seed in (0, 1))
    assert any(np.any(x != y) for x, y in zip(first, second, strict=True))

    stopped, again = (
        tmp_path / "stopped",
        (published, critics, tmp_path / "stopped", steps, 2, False),
    )
    assert train_critics(*again, max_seconds=0.0, **RUN) == {}
    found = train_critics(*again, **RUN)
    for name, agent in found.items():
        for one, two in zip(weights(agent), weights(both[name]), strict=True):
            np.testing.assert_array_equal(one, two)
    with pytest.raises(ValueError, match="trains other critics"):
        train_critics(published, {"third": OTHER, **critics}, stopped, steps, 2, False, **RUN)


def test_an_agent_with_a_new_critic_is_one_like_others(published, robot, tmp_path):
    found = train_critics(published, {"small": SMALL}, tmp_path, 32, progress=False, **RUN)["small"]
    save_agent(found, tmp_path / "agent")
    loaded = load_agent(tmp_path / "agent")
    assert loaded.hash == found.hash and loaded.metadata["policy_evaluation"]["steps"] == 32
    f = np.zeros(robot.design_dim, "f4")
    assert np.isfinite(search("vgds", loaded, robot, f, iterations=2).objective)
    again = train_critic(loaded, SMALL, 32, tmp_path / "agent", progress=False, **RUN)
    assert again.policy_hash == published.policy_hash


def test_scores_on_bodies_never_seen(published, robot, monkeypatch):
    """A critic that knows the returns explains them; one that says the same of all, nothing."""
    monkeypatch.setattr("shapebody.training.critics.AHEAD", 30)
    seen = {}

    class Constant:
        def values(self, descriptions, observation):
            seen["rows"] = observation.general.shape
            return np.full((*observation.general.shape[:-1], 2), 3.0)

    scores = held_out_scores(published, {"constant": Constant()}, bodies=6, moments=3)
    assert seen["rows"] == (3, 6, 13)
    assert scores["constant"].explained_variance == pytest.approx(0, abs=1e-6)
    assert scores["constant"].rmse > 0


def test_variants_are_those_of_the_paper():
    names = list(critic_ablation.variants())
    assert names[0] == "original 1x4" and names[-2] == "direct-design 3x32" and len(names) == 9
    assert critic_ablation.variants()["original 1x4"].heads == 1


def test_ablation_keeps_seeds_apart(published, robot, tmp_path, monkeypatch):
    monkeypatch.setattr("shapebody.training.critics.AHEAD", 20)
    monkeypatch.setenv("SHAPEBODY_DATA", str(tmp_path))
    monkeypatch.setenv("SHAPEBODY_SCALE", "reduced")
    critics = train_critics(
        published, {"small": SMALL, "other": OTHER}, tmp_path / "run", 32, 2, False, **RUN
    )
    setting = dict(starts=2, episodes=2, horizon=20)
    study = critic_ablation.critic_ablation(published, critics, robot, **setting)
    assert study == critic_ablation.critic_ablation(published, critics, robot, **setting)
    predictions, found = study["records"][:4], study["records"][4:]
    assert [row["critic"] for row in predictions] == list(critics)
    assert all(row["parameters"] > 0 and -1 <= row["rho"] <= 1 for row in predictions)
    gains = critic_ablation.critic_gains(found)
    assert {row["critic"] for row in gains} == {None, *critics}
