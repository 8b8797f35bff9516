"""The mirror image of a body: what networks are told of it, what it observes, what it does."""

import copy
import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shapebody.design.descriptions import Sizes, describe
from shapebody.design.mirror import mirror_signs, mirrored
from shapebody.design.space import DesignSpace
from shapebody.robot.robot import load_robot
from shapebody.task.config import TaskConfig
from shapebody.task.observations import Observation, mirrored_observation, observe
from shapebody.task.sensors import reader
from shapebody.training import update
from shapebody.training.config import TrainConfig
from shapebody.training.losses import step_weights
from shapebody.training.trainer import Trainer

pytestmark = pytest.mark.usefixtures("quick")

M = np.array([1.0, -1.0, 1.0])
QUATERNION = np.array([1.0, -1.0, 1.0, -1.0])
# Robots whose reference is symmetric to the digits that their makers give.
SYMMETRIC = ("unitree_go2", "mit_humanoid", "golem")


@pytest.fixture(scope="module")
def space():
    return DesignSpace(load_robot("unitree_go2"))


@pytest.fixture(scope="module")
def described(space):
    return jax.jit(lambda f: describe(space.robot, mirror=True)(space(f)))


def image_of(robot, model: mujoco.MjModel) -> mujoco.MjModel:
    """The mirror image of a model, by hand: every frame, and the joints that are reversed."""
    model = copy.copy(model)
    sign = np.ones(model.njnt)
    sign[robot.joints[robot.actuated]] = mirror_signs(robot)
    for name in ("body_pos", "body_ipos", "geom_pos", "site_pos", "jnt_pos"):
        getattr(model, name)[:] *= M
    for name in ("body_quat", "body_iquat", "geom_quat", "site_quat"):
        getattr(model, name)[:] *= QUATERNION
    model.jnt_axis[:] *= -M * sign[:, None]
    turned = sign < 0
    model.jnt_range[turned] = -model.jnt_range[turned][:, ::-1]
    model.actuator_ctrlrange[:] = _reversed(model.actuator_ctrlrange, mirror_signs(robot))
    model.body_sameframe[:] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    model.geom_sameframe[:] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    model.site_sameframe[:] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    return model


def _reversed(limits, sign):
    return np.where(sign[:, None] < 0, -limits[:, ::-1], limits)


def image_state(robot, qpos, qvel):
    """The mirror image of positions and velocities."""
    qpos, qvel, sign = qpos.copy(), qvel.copy(), mirror_signs(robot)
    qpos[:3] *= M
    qpos[3:7] *= QUATERNION
    qvel[:3] *= M
    qvel[3:6] *= -M
    qpos[robot.qpos_index] *= sign
    qvel[robot.qvel_index] *= sign
    return qpos, qvel


def test_hips_keep_their_axis_and_reversed_joints_get_it(space):
    sign = dict(
        zip(
            [space.robot.model.joint(int(j)).name for j in space.robot.joints],
            mirror_signs(space.robot),
            strict=True,
        )
    )
    # All hips of the Go2 turn about x; its left and right thighs about opposite axes.
    assert sign["FL_hip_joint"] == sign["RR_hip_joint"] == -1
    model, data = space.robot.model, mujoco.MjData(space.robot.model)
    mujoco.mj_kinematics(model, data)
    left, right = (data.xaxis[model.joint(f"F{side}_thigh_joint").id] for side in "LR")
    assert sign["FL_thigh_joint"] == np.sign(left[1] * right[1])


@pytest.mark.parametrize("name", SYMMETRIC)
def test_the_image_of_a_symmetric_robot_has_the_same_parts(name):
    space = DesignSpace(load_robot(name))
    told = jax.jit(describe(space.robot, mirror=True))(space(space.reference))
    for own, image in ((told.joints, told.mirrored.joints), (told.feet, told.mirrored.feet)):
        difference = np.abs(np.asarray(own)[:, None] - np.asarray(image)[None]).max(-1)
        partner = difference.argmin(0)
        assert difference.min(0).max() < 0.005
        assert sorted(partner) == list(range(len(partner)))
    np.testing.assert_allclose(told.static, told.mirrored.static, atol=0.01)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_twice_is_the_identity(described, space, seed):
    told = described(space.start(seed))
    for one, two in zip(*map(jax.tree.leaves, (told, mirrored(mirrored(told)))), strict=True):
        np.testing.assert_array_equal(one, two)
    rng = np.random.default_rng(seed)
    shapes = dict(joints=(12, 4), feet=(4, 3), general=(13,), privileged=(5,))
    seen = Observation(**{k: rng.normal(size=shape).astype("f4") for k, shape in shapes.items()})
    sign = told.mirrored.sign
    again = mirrored_observation(mirrored_observation(seen, sign), sign)
    for one, two in zip(*map(jax.tree.leaves, (seen, again)), strict=True):
        np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_image_is_described_as_a_body_of_its_own(space, described, seed):
    """Against a mirrored embodiment, described like any other: all but what geoms are at rest."""
    robot, f = space.robot, space.start(seed)
    told, sign = described(f), mirror_signs(robot)
    e = jax.tree.map(np.asarray, space(f))
    joints = np.ones(robot.model.njnt)
    joints[robot.joints[robot.actuated]] = sign
    e = dataclasses.replace(
        e,
        **{k: getattr(e, k) * M for k in ("body_pos", "body_ipos", "geom_pos", "site_pos")},
        **{k: getattr(e, k) * QUATERNION for k in ("body_quat", "body_iquat")},
        jnt_pos=e.jnt_pos * M,
        jnt_axis=e.jnt_axis * -M * joints[:, None],
        jnt_range=_reversed(e.jnt_range, joints),
        nominal=e.nominal * sign,
    )
    # Feet and collision spheres of the Go2 are spheres: how their geoms are turned is the same.
    expected = jax.jit(describe(robot))(jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), e))
    found = mirrored(told)
    for name in ("joints", "feet", "static", "nominal", "dimensions", "home_height"):
        one, two = getattr(found, name), getattr(expected, name)
        np.testing.assert_allclose(one, two, atol=2e-5, err_msg=name)


@pytest.mark.parametrize("seed", [4, 5])
def test_the_image_moves_as_the_mirror_shows(space, seed):
    """40 control steps in the C engine, from a mirrored state with mirrored targets."""
    robot, rng = space.robot, np.random.default_rng(seed)
    f, sign = space.start(seed), mirror_signs(space.robot)
    model = space.to_model(f)
    other = image_of(robot, model)
    read, sizes = reader(robot, Sizes.of(robot)), Sizes.of(robot)
    told = jax.jit(describe(robot, sizes, mirror=True))(space(f))
    image = mirrored(told)
    one, two = mujoco.MjData(model), mujoco.MjData(other)
    one.qpos[:] = robot.home
    one.qvel[:] = rng.normal(size=model.nv) * 0.3
    two.qpos[:], two.qvel[:] = image_state(robot, one.qpos, one.qvel)
    config = TaskConfig()
    for step in range(40):
        action = rng.normal(size=robot.num_actuators).astype("f4") * 0.5
        one.ctrl[:] = np.asarray(told.nominal) + float(told.action_scale) * action
        two.ctrl[:] = np.asarray(image.nominal) + float(image.action_scale) * action * sign
        for _ in range(4):
            mujoco.mj_step(model, one)
            mujoco.mj_step(other, two)
        seen = []
        for data, body, sent, clock, turn in (
            (one, told, action, 0.3, 1.0),
            (two, image, action * sign, 0.3 + np.pi, -1.0),
        ):
            rows = [np.float32(x)[None] for x in (data.qpos, data.qvel, data.sensordata)]
            readings = jax.tree.map(lambda x: x[0], read(*rows, np.ones(1, bool)))
            command = np.array([0.5, 0.2 * turn, 0.4 * turn], "f4")
            rest = [np.zeros(4, "f4")] * 3
            arguments = readings, body, command, np.zeros(12, "f4"), sent, np.float32(clock)
            key = jax.random.PRNGKey(0)
            seen.append(observe(config, key, *arguments, *rest, np.float32(0)))
        expected = mirrored_observation(seen[0], told.mirrored.sign)
        # Contacts amplify rounding: the images stay together to a thousandth for 0.8 s.
        for name in ("joints", "general", "privileged"):
            x, y = getattr(expected, name), getattr(seen[1], name)
            np.testing.assert_allclose(x, y, atol=1e-3, err_msg=f"{name} in step {step}")
    assert one.ncon and np.abs(one.qpos[:3] - robot.home[:3]).max() > 0.01


@pytest.fixture(scope="module")
def rollout(tmp_path_factory):
    """A trainer that learns from mirror images, and a rollout of its policy on random bodies."""
    config = TrainConfig.smoke("unitree_go2", mirror_coefficient=10.0, mirrored_critic=True)
    trainer = Trainer(config, tmp_path_factory.mktemp("mirror"))
    trainer.start()
    key = jax.random.PRNGKey(0)
    state = trainer.env.reset(key, coefficient=0.5)
    length = config.rollout_length
    _, trajectory = trainer.env.rollout(
        trainer.actor.act, trainer.learner.policy, state, key, length
    )
    return trainer, trajectory


def test_the_mirror_loss_makes_a_policy_symmetric(rollout):
    trainer, trajectory = rollout
    learner, defects = trainer.learner, []
    for number in range(8):
        learner, metrics = update.ppo_update(
            trainer.config, learner, trajectory, jax.random.PRNGKey(number)
        )
        defects.append(float(metrics["mirror"]))
    assert 0 < defects[-1] < 0.5 * defects[0]


def test_the_critic_learns_images_where_it_is_told(rollout):
    trainer, trajectory = rollout
    batch, _ = update.prepare(trainer.config, trainer.learner, trajectory)
    params, fixed = trainer.learner.critic["params"], update.constants(trainer.learner.critic)
    weight = step_weights(batch.valid)

    def loss(flipped, batch=batch):
        flipped = None if flipped is None else np.asarray(flipped)
        batch = dataclasses.replace(batch, flipped=flipped)
        return float(update.critic_loss(trainer.config, params, fixed, batch, weight))

    none, every = np.zeros(len(weight), bool), np.ones(len(weight), bool)
    image = dataclasses.replace(
        batch,
        descriptions=mirrored(batch.descriptions),
        observation=mirrored_observation(
            batch.observation, batch.descriptions.mirrored.sign[:, :1]
        ),
    )
    assert loss(none) == pytest.approx(loss(None)) and loss(every) != pytest.approx(loss(None))
    assert loss(every) == pytest.approx(loss(None, image), rel=1e-5)


def test_without_images_there_is_a_clear_error(space):
    with pytest.raises(ValueError, match="mirror=True"):
        mirrored(describe(space.robot)(space(space.reference)))
