"""All shipped robots: the paper's table, standing, random bodies, mixed batches, MJX."""

import collections
import importlib.util
import json

import jax
import mujoco
import numpy as np
import pytest

from shapebody.design.descriptions import Sizes
from shapebody.design.phi import MODEL_FIELDS
from shapebody.design.space import DesignSpace
from shapebody.files import data_dir
from shapebody.reproduction import paper
from shapebody.reproduction.robot_catalog import random_bodies, robot_table
from shapebody.robot.robot import load_robot, robots
from shapebody.task.config import TaskConfig
from shapebody.task.env import Locomotion
from shapebody.training import config as training_config
from shapebody.training import trainer as training_trainer

SMALL = {"quadruped": "bittle", "biped": "bolt", "humanoid": "robotis_op3", "hexapod": "crab"}
"""A robot of each morphology that compiles quickly."""

QUIET = dict(
    noise_joint_position=0.0,
    noise_joint_velocity=0.0,
    noise_angular_velocity=0.0,
    noise_gravity=0.0,
    push_probability=0.0,
)


pytestmark = pytest.mark.usefixtures("quick")


def test_the_table_is_the_papers():
    rows = {row["name"]: row for row in robot_table()}
    assert rows.keys() == paper.ROBOT_TABLE.keys() and len(rows) == 50
    for name, printed in paper.ROBOT_TABLE.items():
        row = rows[name]
        ours = tuple(
            row[key] for key in ("p_gain", "d_gain", "action_scale", "actuators", "design_dim")
        )
        assert ours == printed, name
    kinds = collections.Counter(row["morphology"] for row in rows.values())
    assert kinds["quadruped"] == 15 and kinds["hexapod"] == 4
    assert kinds["biped"] + kinds["humanoid"] == 31
    for row in rows.values():
        feet = {"quadruped": 4, "biped": 2, "humanoid": 2, "hexapod": 6}[row["morphology"]]
        assert row["feet"] == feet and 0.1 < row["mass"] < 200 and 0.05 < row["height"] < 1.5


def test_every_robot_has_its_sources():
    text = (data_dir() / "robots" / "SOURCES.md").read_text()
    for name in robots():
        assert f"(`{name}`)" in text
    sections = text.split("\n## ")[1:]
    assert len(sections) == 50
    for section in sections:
        assert "- Source:" in section and "- Estimated:" in section, section.splitlines()[0]


@pytest.mark.parametrize("name", paper.ROBOT_TABLE)
def test_stands_and_keeps_its_reference(name):
    robot = load_robot(name)
    model, data = robot.model, mujoco.MjData(robot.model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    mujoco.mj_forward(model, data)
    vertical = np.abs(data.geom_xmat[robot.feet].reshape(-1, 3, 3)[:, 2])
    size = model.geom_size[robot.feet]
    reach = np.where(robot.foot_types == 1, (vertical * size).sum(-1), size[:, 0])
    lowest = data.geom_xpos[robot.feet, 2] - reach
    assert abs(lowest.min()) < 1e-6 and lowest.max() < 0.015 * robot.home[2], "a foot is in the air"
    low, high = model.jnt_range[robot.joints[robot.actuated]].T
    assert np.all((low <= robot.nominal) & (robot.nominal <= high))
    touching = set()
    for _ in range(40):  # 0.2 s: the soft gains let it sink, but not fall
        mujoco.mj_step(model, data)
        touching |= {int(geom) for contact in data.contact for geom in contact.geom}
    assert np.isfinite(data.qpos).all() and data.qpos[2] > 0.75 * robot.home[2]
    assert touching == {robot.floor, *robot.feet}

    # Φ(0) is the reference.
    body = DesignSpace(robot)(np.zeros(robot.design_dim, np.float32))
    for field in MODEL_FIELDS:
        np.testing.assert_allclose(
            getattr(body, field), getattr(model, field), rtol=1e-5, atol=1e-6, err_msg=field
        )
    # A nominal position at the edge of its range is pulled inside the soft limits.
    middle, half = (low + high) / 2, 0.9 * (high - low) / 2
    soft = np.clip(robot.nominal, middle - half, middle + half)
    np.testing.assert_allclose(body.nominal, soft, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(body.action_scale, robot.action_scale, rtol=1e-6)


@pytest.mark.parametrize("name", paper.ROBOT_TABLE)
def test_random_bodies_step(name):
    """As in the shipped table: 200 designs of the full space for one second."""
    record = random_bodies(load_robot(name))
    stored = json.loads((data_dir() / "results" / "random_bodies.json").read_text())
    expected = next(row for row in stored["parts"]["all"]["records"] if row["name"] == name)
    assert record.keys() == expected.keys()
    for key, value in record.items():
        if isinstance(value, float):
            # Chaotic motion differs between processors; the shares hardly do.
            assert value == pytest.approx(expected[key], abs=0.08), key
        else:
            assert value == expected[key], key
    assert record["non_finite_random"] < 0.5


@pytest.mark.parametrize("morphology", SMALL)
def test_steps_on_mjx(morphology):
    from shapebody.physics.mjx import MjxPhysics
    from shapebody.physics.native import NativePhysics

    robot = load_robot(SMALL[morphology])
    assert robot.morphology == morphology
    f = 0.3 * DesignSpace(robot).start(0)
    body = jax.vmap(DesignSpace(robot))(f[None])
    options = dict(solver_iterations=4, line_search=8)
    native = NativePhysics(robot, 1, threads=1, **options)
    native.set_designs(np.arange(1), jax.tree.map(np.asarray, body))
    physics = MjxPhysics(robot, 1, **options)
    qpos, qvel = robot.home[None], np.zeros((1, robot.model.nv))
    state = physics.init(body, qpos.astype(np.float32), qvel.astype(np.float32))
    native.set_state(np.arange(1), qpos, qvel)
    target = robot.nominal[None] + 0.2 * robot.action_scale
    step = jax.jit(physics.step)
    for _ in range(3):
        state, moved, *_, finite = step(state, target.astype(np.float32))
        expected = native.step(target)
        assert np.all(finite) and expected.finite.all()
    np.testing.assert_allclose(moved, expected.qpos, atol=2e-3)


@pytest.fixture(scope="module")
def everyone():
    return [load_robot(name) for name in robots()]


@pytest.fixture(scope="module")
def trained(everyone, tmp_path_factory):
    """Two iterations of PPO with one policy and one critic for all robots."""
    config = training_config.TrainConfig.smoke(
        everyone[0].name,
        robots=tuple(robot.name for robot in everyone),
        name="fifty",
        num_envs=100,
        rollout_length=8,
        minibatch_size=400,
        total_steps=1600,
    )
    trainer = training_trainer.Trainer(config, tmp_path_factory.mktemp("fifty"), engine="native")
    trainer.start()
    before = jax.tree.map(np.array, trainer.learner.policy)
    trainer.run(progress=False)
    return trainer, before


def test_one_policy_trains_on_all_robots(trained):
    trainer, before = trained
    assert trainer.steps == 1600 and len(trainer.env.groups) == 50
    assert trainer.env.sizes == Sizes.of(*trainer.env.robots)
    after = trainer.learner.policy
    change = [
        np.abs(a - b).max()
        for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True)
    ]
    assert max(change) > 1e-4
    leaves = jax.tree.leaves((after, trainer.learner.critic))
    assert all(np.isfinite(leaf).all() for leaf in leaves)
    states, owners = trainer.state_bank(rollouts=2)
    assert len(owners) == 64 and np.all((0 <= owners) & (owners < 50))
    for joints, feet, owner in zip(states.joints, states.feet, owners, strict=True):
        robot = trainer.env.robots[owner]
        assert np.all(joints[robot.num_actuators :] == 0) and np.all(feet[robot.num_feet :] == 0)


def wave(params, key, descriptions, observation):
    """A policy without randomness, so that company cannot matter through it."""
    return np.float32(0.3) * (1 - 2 * descriptions.joints[..., 0]), ()


def test_company_changes_no_trajectory(trained):
    """A robot of each morphology, and those with most joints and feet, alone and among all."""
    config = TaskConfig(**QUIET)
    mixed = trained[0].env.with_task(config)
    designs = np.zeros((mixed.num_envs, mixed.design_dim), np.float32)
    rng = np.random.default_rng(0)
    for group in mixed.groups:
        designs[group.slice, : group.space.dim] = rng.uniform(-0.3, 0.3, group.space.dim)
    keys = jax.random.split(jax.random.PRNGKey(3), mixed.num_envs)
    state = mixed.reset(None, designs=designs, keys=keys)
    _, together = mixed.rollout(wave, None, state, jax.random.PRNGKey(0), 6)
    for name in (*SMALL.values(), "fourier_gr1t2", "golem"):
        group = next(g for g in mixed.groups if g.robot.name == name)
        own, robot = group.slice, group.robot
        alone = Locomotion(robot, group.count, engine="native", config=config, threads=1)
        state = alone.reset(None, designs=designs[own, : robot.design_dim], keys=keys[own])
        _, single = alone.rollout(wave, None, state, jax.random.PRNGKey(0), 6)
        close = dict(rtol=1e-3, atol=1e-4)
        positions = alone.groups[0].physics.qpos
        np.testing.assert_allclose(group.physics.qpos, positions, **close, err_msg=name)
        np.testing.assert_allclose(together.reward[:, own], single.reward, rtol=1e-3, atol=1e-5)
        for part, count in (("joints", robot.num_actuators), ("feet", robot.num_feet)):
            padded = getattr(together.observation, part)[:, own]
            expected = getattr(single.observation, part)
            np.testing.assert_allclose(padded[:, :, :count], expected, **close, err_msg=name)
            assert np.all(padded[:, :, count:] == 0)


def test_files_are_what_the_builder_makes_of_the_sheets():
    folder = data_dir() / "robots"
    spec = importlib.util.spec_from_file_location("build", folder / "build.py")
    builder = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(builder)
    sheets = {path.stem: json.loads(path.read_text()) for path in folder.glob("sheets/*.json")}
    assert sorted(sheets) == robots()
    for name, sheet in sheets.items():
        assert builder.build(sheet) == (folder / f"{name}.xml").read_text(), name
    licences = json.loads((folder / "licences.json").read_text())
    ordered = [sheets[name] for name in sorted(sheets)]
    assert builder.sources(ordered, licences) == (folder / "SOURCES.md").read_text()
