"""The small state of a run: same networks and curriculum, new episodes."""

import shutil
from dataclasses import replace

import jax
import numpy as np
import optax
import pytest

from shapebody.files import data_dir
from shapebody.training import portable, run_state, trainer
from shapebody.training.config import TrainConfig

pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture(scope="module", params=[None, 1000.0], ids=["latest", "averaged"])
def run(request, robot, tmp_path_factory):
    """A run of two iterations, and the folder of its small state."""
    config = TrainConfig.smoke(str(robot.path), average_half_life=request.param)
    first = trainer.Trainer(config, tmp_path_factory.mktemp("run"))
    first.start()
    first.actor.reset(np.linspace(0, 1, config.num_envs, dtype=np.float32))
    first.run(max_steps=2 * config.batch, progress=False)
    first.save_portable()
    small = tmp_path_factory.mktemp("small")
    for name in (run_state.PORTABLE, run_state.PHASES, run_state.CURVE):
        shutil.copyfile(first.folder / name, small / name)
    return first, small


def test_a_run_goes_on_from_it(run, tmp_path):
    first, small = run
    folder = tmp_path / "copy"
    shutil.copytree(small, folder)
    again = trainer.Trainer(first.config, folder)
    assert again.start() and again.steps == first.steps and again.seconds == first.seconds
    for name in ("policy", "critic"):
        jax.tree.map(
            np.testing.assert_array_equal,
            getattr(again.learner, name),
            getattr(first.learner, name),
        )
    # Every environment has its c, and another episode.
    np.testing.assert_array_equal(again.actor.state.coefficient, first.actor.state.coefficient)
    assert np.all(np.any(again.actor.state.key != first.actor.state.key, axis=-1))
    # It goes on, and from then on exactly.
    again.run(max_steps=first.steps + 2 * first.config.batch, progress=False)
    assert (folder / run_state.STATE).exists()
    exact = trainer.Trainer(first.config, folder)
    assert exact.start() and exact.steps == again.steps
    jax.tree.map(np.testing.assert_array_equal, exact.learner, again.learner)


def test_rounding(run):
    first, small = run
    like = first.learner
    zeros = jax.tree.map(lambda x: 0 * x, like)
    saved, *_ = portable.load_portable(small / run_state.PORTABLE, zeros, first.config.num_envs)
    for name in ("policy_optimizer", "critic_optimizer"):
        old, new = getattr(like, name), getattr(saved, name)
        assert optax.tree.get(old, "count") == optax.tree.get(new, "count")

        def near(x, y):
            assert np.abs(x - y).max() <= np.abs(x).max() / 250 + 1e-30

        def within_octaves(x, y):
            seen = x > x.max() * 2.0**-31
            np.testing.assert_allclose(x[seen], y[seen], rtol=0.05)
            assert np.all(y[~seen] <= x.max() * 2.0**-30)

        jax.tree.map(near, optax.tree.get(old, "mu"), optax.tree.get(new, "mu"))
        jax.tree.map(within_octaves, optax.tree.get(old, "nu"), optax.tree.get(new, "nu"))
    if like.average is not None:
        jax.tree.map(
            lambda x, y: np.testing.assert_allclose(x, y, atol=1e-4), like.average, saved.average
        )


def test_a_damaged_one_is_refused(run, tmp_path):
    first, small = run
    shutil.copytree(small, tmp_path / "copy")
    path = tmp_path / "copy" / run_state.PORTABLE
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(ValueError, match="portable"):
        trainer.Trainer(first.config, path.parent).start()


def test_another_configuration_does_not_continue_it(run, tmp_path):
    first, small = run
    with pytest.raises(ValueError, match="another configuration"):
        trainer.Trainer(replace(first.config, discount=0.5), small).start()


@pytest.mark.parametrize("name", ["unitree_go2", "mit_humanoid", "golem"])
def test_shipped_runs_are_small_and_can_be_continued(name):
    folder = data_dir() / "checkpoints" / name
    path = folder / run_state.PORTABLE
    assert path.stat().st_size < 1.5e6
    config = run_state.read_config(folder)
    assert run_state.finished_iterations(folder) * config.batch > 20e6
