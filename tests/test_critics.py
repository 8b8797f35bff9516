"""Comparisons of several critics of one policy."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from tiny import tiny_agent

from shapebody.design.space import DesignSpace
from shapebody.evaluation.evaluate import EvaluationConfig, evaluate
from shapebody.evaluation.statistics import paired_gain
from shapebody.optimizers.search import search
from shapebody.reproduction import critic_ablation, value_studies
from shapebody.task.config import TaskConfig

SETTING = dict(starts=2, first_start=5, episodes=3, horizon=12)


pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture(scope="module")
def pair(robot):
    """One policy with a critic, and with the negative of its last layer."""
    one = tiny_agent(robot)
    other = replace(one, critic=jax.tree.map(lambda x: -x, one.critic))
    assert one.policy_hash == other.policy_hash and one.hash != other.hash
    return {"one": one, "other": other}


def test_records_are_what_search_and_evaluation_give(pair, robot):
    records = critic_ablation.compare_critics(pair, robot, (20.0,), **SETTING)
    expected = [(None, None), ("one", 20.0), ("other", 20.0)]
    assert [(r["critic"], r["trust_region"]) for r in records[::2]] == expected
    assert [r["start"] for r in records] == [5, 6] * 3
    initial = np.stack([DesignSpace(robot).start(i) for i in (5, 6)])
    found = search("vgds", pair["other"], robot, initial, trust_region=20.0).design
    config = EvaluationConfig(episodes=3, task=TaskConfig.evaluation(horizon=12))
    score = evaluate(pair["other"], robot, found, config=config)
    returns = [r["returns"] for r in records[4:]]
    np.testing.assert_allclose(returns, score.returns, atol=1e-3)
    np.testing.assert_allclose([r["size"] for r in records[4:]], found[:, :3], atol=1e-4)
    rows = critic_ablation.critic_gains(records)
    assert rows[0]["critic"] is None and rows[0]["mean"] is None
    own = paired_gain(returns, [r["returns"] for r in records[:2]])
    assert (rows[2]["mean"], rows[2]["low"], rows[2]["high"]) == own[:3]
    assert rows[2]["size"] == pytest.approx(found[:, :3].mean(0).tolist(), abs=1e-4)


def test_correlations_are_each_critics_own(pair, robot):
    values = value_studies.value_against_return(
        pair["one"], robot, designs=12, episodes=1, horizon=5
    )
    for record in values:
        record["return"] = record["predicted_value"]
    rho = critic_ablation.critic_correlations(pair, robot, values)
    assert rho["one"][0] == pytest.approx(1)
    assert rho["other"][0] < 1


def test_another_policy_is_refused(pair, robot):
    stranger = replace(pair["one"], policy=jax.tree.map(lambda x: x + 1, pair["one"].policy))
    with pytest.raises(ValueError, match="one, stranger belong to 2 policies; expected one"):
        critic_ablation.compare_critics(
            {"one": pair["one"], "stranger": stranger}, robot, **SETTING
        )


def test_two_tasks_are_compared_and_kept(pair, robot, tmp_path, monkeypatch):
    monkeypatch.setenv("SHAPEBODY_DATA", str(tmp_path))
    monkeypatch.setenv("SHAPEBODY_SCALE", "reduced")
    short = dict(starts=2, episodes=2, horizon=3)
    study = critic_ablation.critic_tasks(pair["one"], pair["other"], robot, **short)
    assert len(study["records"]) == 2 + 2 * 2 * 2 + 2
    assert {r["critic"] for r in study["records"]} == {
        None,
        "task of the training",
        "task of the evaluation",
    }
    monkeypatch.setattr(critic_ablation, "search", None)
    assert critic_ablation.critic_tasks(pair["one"], pair["other"], robot, **short) == study
