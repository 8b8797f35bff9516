"""Kinematics and descriptions against MuJoCo and an independent NumPy version."""

import dataclasses
from itertools import combinations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from shapebody.design.descriptions import Descriptions, Sizes, describe, symmetric_feet
from shapebody.design.kinematics import kinematics
from shapebody.design.space import DesignSpace
from shapebody.robot.robot import load_robot
from shapebody.robot.spec_edits import COLLISION_GROUP

ROBOTS = ("unitree_go2", "mit_humanoid", "golem")
FIELDS = [field.name for field in dataclasses.fields(Descriptions) if field.name != "mirrored"]

# A leg with a body without joint, a body with two joints, joint anchors away from the body's
# origin, and a joint without actuator.
MIXED = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 0.05"/>
    <body name="trunk">
      <freejoint/>
      <inertial pos="0 0 0" mass="2" diaginertia="0.02 0.02 0.02"/>
      <site name="imu" pos="0.01 0 0.02"/>
      <geom name="ball" type="sphere" size="0.1" group="5" pos="0.3 0 0"/>
      <body name="tail" pos="-0.1 0 0">
        <inertial pos="-0.05 0 0" mass="0.1" diaginertia="0.001 0.001 0.001"/>
        <joint name="tail" axis="0 0 1" range="-1 1"/>
      </body>
      <body name="bracket" pos="0.1 0.05 -0.05" quat="0.9 0.1 0.2 -0.1">
        <inertial pos="0 0 0.01" mass="0.2" diaginertia="0.001 0.002 0.002"/>
        <body name="leg" pos="0 0.02 -0.05">
          <inertial pos="0 0 -0.1" quat="0.8 0.2 0.1 0" mass="0.5" diaginertia="0.01 0.01 0.002"/>
          <joint name="abduction" axis="1 0 0" pos="0 0.01 0.02" range="-1 1"/>
          <joint name="flexion" axis="0 1 0" pos="0 0 -0.01" range="-2 2"/>
          <geom name="foot" type="sphere" size="0.03" pos="0 0 -0.2"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="flexion" joint="flexion" kp="20" kv="0.5" forcerange="-10 10"/>
    <position name="abduction" joint="abduction" kp="20" kv="0.5" forcerange="-12 12"/>
  </actuator>
  <keyframe><key name="home" qpos="0 0 0.3 1 0 0 0 0.2 0.1 0.4" ctrl="0.4 0.1"/></keyframe>
  <custom>
    <numeric name="action_scale" data="0.3"/>
    <numeric name="velocity_limits" data="20 25"/>
  </custom>
</mujoco>
"""


@pytest.fixture(scope="module")
def spaces(tmp_path_factory):
    path = tmp_path_factory.mktemp("robots") / "mixed.xml"
    path.write_text(MIXED, encoding="utf-8")
    robots = {name: load_robot(name) for name in ROBOTS} | {"mixed": load_robot(path)}
    return {name: DesignSpace(robot) for name, robot in robots.items()}


@pytest.fixture(scope="module")
def described(spaces):
    """Jitted maps from designs to unpadded descriptions."""
    functions = {}
    for name, space in spaces.items():
        build = describe(space.robot)
        functions[name] = jax.jit(lambda f, space=space, build=build: build(space(f)))
    return functions


@pytest.mark.parametrize("name", ("unitree_go2", "mit_humanoid", "mixed"))
def test_kinematics_agrees_with_mujoco(spaces, name):
    space = spaces[name]
    robot, model = space.robot, space.robot.model
    rng = np.random.default_rng(1)
    forward = jax.jit(lambda f, qpos: kinematics(robot)(space(f), qpos))
    for seed in range(4):
        f = space.start(seed)
        design = space.to_model(f)
        data = mujoco.MjData(design)
        data.qpos[:3] = rng.normal(size=3)
        data.qpos[3:7] = rng.normal(size=4)
        data.qpos[7:] = rng.uniform(-2, 2, model.nq - 7)
        frames = forward(f, np.asarray(data.qpos, np.float32))
        mujoco.mj_kinematics(design, data)
        expected = {
            "body_pos": data.xpos,
            "body_rot": data.xmat.reshape(-1, 3, 3),
            "geom_pos": data.geom_xpos,
            "geom_rot": data.geom_xmat.reshape(-1, 3, 3),
            "site_pos": data.site_xpos,
            "site_rot": data.site_xmat.reshape(-1, 3, 3),
            "joint_anchor": data.xanchor[robot.joints],
            "joint_axis": data.xaxis[robot.joints],
            "com": data.xipos,
        }
        for field, value in expected.items():
            np.testing.assert_allclose(getattr(frames, field), value, atol=1e-5, err_msg=field)


def slow_descriptions(robot, model, e):
    """All of `Descriptions` without masks and padding, float64, through MuJoCo's frames."""
    data = mujoco.MjData(model)
    data.qpos[:] = robot.home
    data.qpos[robot.qpos_index] = e.nominal
    mujoco.mj_forward(model, data)
    trunk_rot, origin = data.xmat[1].reshape(3, 3), data.xpos[1]

    def local(point):
        return trunk_rot.T @ (point - origin)

    spheres = [g for g in range(model.ngeom) if model.geom_group[g] == COLLISION_GROUP]
    names = [model.geom(g).name for g in range(model.ngeom)]
    feet = [g for g in range(model.ngeom) if "foot" in names[g]]
    joints = [int(model.actuator_trnid[u, 0]) for u in range(model.nu)]
    points = []
    for g in spheres + feet:
        rotated = np.abs(trunk_rot.T @ data.geom_xmat[g].reshape(3, 3) @ model.geom_size[g])
        points += [local(data.geom_xpos[g]) - rotated, local(data.geom_xpos[g]) + rotated]
    points += [local(data.xanchor[j]) for j in joints]
    points += [local(data.xipos[b]) for b in range(1, model.nbody)]
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    dimensions = high - low

    def relative(point):
        return 2 * (local(point) - low) / dimensions - 1

    def body(b):
        moments = trunk_rot.T @ data.ximat[b].reshape(3, 3) @ model.body_inertia[b]
        return [model.body_mass[b] / 200 - 1, *relative(data.xipos[b]), *(moments / 13 - 1)]

    mass = sum(model.body_mass[1:])
    p_gain, d_gain = model.actuator_gainprm[0, 0], -model.actuator_biasprm[0, 2]
    scale = float(e.action_scale)
    whole = [p_gain / 85 - 1, d_gain - 1, scale / 0.75 - 1, mass / 450 - 1]
    whole += list(dimensions / 1.5 - 1)
    joint_rows = []
    for u, j in enumerate(joints):
        b, dof = model.jnt_bodyid[j], model.jnt_dofadr[j]
        children = sum(model.body_parentid[c] == b for c in range(1, model.nbody))
        joint_rows.append(
            [
                *relative(data.xanchor[j]),
                *(trunk_rot.T @ data.xaxis[j]),
                *body(b),
                children / 2.5 - 1,
                data.qpos[model.jnt_qposadr[j]] / 6.5,
                model.actuator_forcerange[u, 1] / 800 - 1,
                e.velocity_limits[u] / 90 - 1,
                model.dof_damping[dof] / 0.1 - 1,
                model.dof_armature[dof] / 1.35 - 1,
                model.jnt_stiffness[j] / 0.1 - 1,
                model.dof_frictionloss[dof] / 18.5 - 1,
                *(model.jnt_range[j] / 6.5),
                *whole,
            ]
        )
    foot_rows = []
    for g in feet:
        is_box = model.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX
        foot_rows.append(
            [
                *relative(data.geom_xpos[g]),
                *body(model.geom_bodyid[g]),
                *(model.geom_size[g] / 0.15 - 1),
                1 if is_box else -1,
                *whole,
            ]
        )
    collisions = 0
    for g, h in combinations(spheres, 2):
        distance = np.linalg.norm(data.geom_xpos[g] - data.geom_xpos[h])
        collisions += distance < model.geom_size[g, 0] + model.geom_size[h, 0]
    lowest = min(data.geom_xpos[g, 2] for g in feet)
    ranges = model.jnt_range[joints]
    middle, half = ranges.mean(axis=1), (ranges[:, 1] - ranges[:, 0]) / 2
    return {
        "joints": joint_rows,
        "joint_mask": np.ones(model.nu),
        "feet": foot_rows,
        "foot_mask": np.ones(len(feet)),
        "static": whole + body(1),
        "nominal": data.qpos[robot.qpos_index],
        "action_scale": scale,
        "velocity_limits": e.velocity_limits,
        "soft_limits": np.stack([middle - 0.9 * half, middle + 0.9 * half], axis=1),
        "keep_nominal": robot.keep_nominal,
        "foot_size": model.geom_size[feet],
        "foot_is_box": [model.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX for g in feet],
        "foot_pairs": symmetric_feet(robot),
        "sphere_radius": model.geom_size[spheres, 0],
        "sphere_mask": np.ones(len(spheres)),
        "home_height": robot.home[2] - lowest,
        "imu_height": data.site("imu").xpos[2] - lowest,
        "nominal_collisions": collisions,
        "dimensions": dimensions,
        "total_mass": mass,
    }


@pytest.mark.parametrize("name", (*ROBOTS, "mixed"))
def test_descriptions_agree_with_independent_version(spaces, described, name):
    space = spaces[name]
    for f in (space.reference, space.start(3), space.start(8)):
        actual = described[name](f)
        expected = slow_descriptions(space.robot, space.to_model(f), space(f))
        assert set(expected) == set(FIELDS)
        for field, value in expected.items():
            entry = np.asarray(getattr(actual, field))
            assert entry.dtype == np.float32
            value = np.asarray(value, np.float64)
            np.testing.assert_allclose(entry, value, rtol=3e-6, atol=1e-5, err_msg=field)


def test_go2_reference_by_hand(spaces, described):
    d = jax.tree.map(np.asarray, described["unitree_go2"](spaces["unitree_go2"].reference))
    np.testing.assert_allclose(d.static[:3], [20 / 85 - 1, 0.5 - 1, 0.3 / 0.75 - 1], rtol=1e-6)
    np.testing.assert_allclose(d.total_mass, 6.921 + 4 * (0.678 + 1.152 + 0.241352), rtol=1e-6)
    # Thigh and calf 0.213 m long, nominal thigh 0.8 and calf -1.5 rad, foot 0.002 m behind.
    height = 0.213 * (np.cos(0.8) + np.cos(0.7)) - 0.002 * np.sin(0.7)
    np.testing.assert_allclose(d.imu_height - d.home_height, 0.04232, atol=1e-6)
    assert abs(d.home_height - height * np.cos(0.1)) < 0.015
    first = d.joints[0]
    np.testing.assert_allclose(first[3:6], [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(first[6], 0.678 / 200 - 1, rtol=1e-6)
    np.testing.assert_allclose(first[13], 1 / 2.5 - 1, rtol=1e-6)
    listed = [0.1 / 6.5, 23.7 / 800 - 1, 30.1 / 90 - 1, 0.01 / 0.1 - 1, 0.01 / 1.35 - 1, -1]
    listed += [0.2 / 18.5 - 1, -1.0472 / 6.5, 1.0472 / 6.5]
    np.testing.assert_allclose(first[14:23], listed, rtol=1e-5)
    np.testing.assert_allclose(d.feet[0][10:14], [0.022 / 0.15 - 1, -1, -1, -1], rtol=1e-6)


@pytest.mark.parametrize("name", ROBOTS)
def test_boxed_points_lie_in_the_unit_cube(spaces, described, name):
    d = described[name](spaces[name].start(0))
    for rows, columns in ((d.joints, (0, 7)), (d.feet, (0, 4))):
        for first in columns:
            assert np.all(np.abs(np.asarray(rows)[:, first : first + 3]) <= 1 + 1e-5)


def test_foot_pairs(spaces):
    """Left and right legs of the shipped robots are mirror images."""
    pairs = {name: np.argwhere(symmetric_feet(spaces[name].robot)) for name in spaces}
    assert pairs["unitree_go2"].tolist() == [[0, 1], [2, 3]]
    assert pairs["mit_humanoid"].tolist() == [[0, 1]]
    assert pairs["golem"].tolist() == [[0, 3], [1, 4], [2, 5]]
    assert pairs["mixed"].tolist() == []


def test_sizes(spaces):
    robots = [spaces[name].robot for name in ROBOTS]
    sizes = Sizes.of(*robots)
    assert (sizes.joints, sizes.feet) == (24, 6)
    assert sizes.spheres == max(robot.num_spheres for robot in robots)
    with pytest.raises(ValueError, match="sizes.feet is 4, expected at least 6.*Sizes.of"):
        describe(robots[2], Sizes(joints=24, feet=4, spheres=99))


def test_padding_changes_nothing(spaces, described):
    name = "mit_humanoid"
    space = spaces[name]
    own = Sizes.of(space.robot)
    larger = Sizes(own.joints + 3, own.feet + 2, own.spheres + 5)
    padded = describe(space.robot, larger)
    f = space.start(4)
    a, b = described[name](f), jax.jit(lambda f: padded(space(f)))(f)
    np.testing.assert_array_equal(b.joint_mask, np.arange(larger.joints) < own.joints)
    np.testing.assert_array_equal(b.foot_mask, np.arange(larger.feet) < own.feet)
    np.testing.assert_array_equal(b.sphere_mask, np.arange(larger.spheres) < own.spheres)
    for field in FIELDS:
        short, long = np.asarray(getattr(a, field)), np.asarray(getattr(b, field)).copy()
        inner = tuple(slice(0, length) for length in short.shape)
        np.testing.assert_allclose(long[inner], short, rtol=1e-6, atol=1e-6, err_msg=field)
        long[inner] = 0
        assert not long.any(), field


def test_batches_agree_with_single_designs(spaces, described):
    space = spaces["unitree_go2"]
    function = described["unitree_go2"]
    designs = np.stack([space.start(seed) for seed in range(6)]).reshape(3, 2, -1)
    batch = function(designs)
    single = function(designs[2, 0])
    for field in FIELDS:
        entry, expected = getattr(batch, field)[2, 0], getattr(single, field)
        np.testing.assert_allclose(entry, expected, rtol=1e-5, atol=1e-6, err_msg=field)


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_any_design_has_sound_descriptions(spaces, described, data):
    name = data.draw(st.sampled_from(ROBOTS))
    space = spaces[name]
    entries = st.one_of(st.sampled_from([-1.0, 0.0, 1.0]), st.floats(-1, 1, width=32))
    f = data.draw(hnp.arrays(np.float32, space.dim, elements=entries, fill=entries))
    d = jax.tree.map(np.asarray, described[name](f))
    for field in FIELDS:
        assert np.all(np.isfinite(getattr(d, field))), field
    assert np.all(d.dimensions > 0) and d.total_mass > 0
    count = d.sphere_mask.sum()
    assert 0 <= d.nominal_collisions <= count * (count - 1) / 2


def test_gradient_against_finite_differences(spaces, described):
    """Along random directions; differences are taken in float64 by the independent version."""
    space = spaces["unitree_go2"]
    rng = np.random.default_rng(3)
    f = 0.3 * space.start(9)
    fields = [field for field in FIELDS if field != "nominal_collisions"]
    shapes = jax.eval_shape(described["unitree_go2"], f)
    weights = {field: rng.normal(size=getattr(shapes, field).shape) for field in fields}
    build = describe(space.robot)

    def scalar(e):
        d = build(e)
        return sum(jnp.sum(weights[field] * getattr(d, field)) for field in fields)

    differentiate = jax.jit(jax.grad(scalar))
    for design in (space.reference, space.start(0)):
        leaves = jax.tree.leaves(differentiate(space(design)))
        assert all(np.all(np.isfinite(leaf)) for leaf in leaves)
    e = space(f)
    gradient = differentiate(e)

    # Small enough a step that no other geom becomes the outermost one.
    step, model = 1e-5, space.to_model(f)
    moved = ("body_ipos", "body_pos", "geom_pos", "geom_size", "jnt_axis", "body_inertia")
    moved += ("body_mass", "jnt_range", "dof_damping", "site_pos", "actuator_forcerange")
    for field in moved:
        direction = rng.normal(size=getattr(model, field).shape)
        if field == "geom_size":
            direction *= model.geom_size > 0
        elif field == "jnt_axis":
            # MuJoCo rotates about the given axis, so it must stay a unit vector.
            direction = np.cross(direction, model.jnt_axis)
        elif field == "actuator_forcerange":
            direction[:, 0] = 0
        values = []
        for sign in (1, -1):
            changed = space.to_model(f)
            getattr(changed, field)[:] += sign * step * direction
            d = slow_descriptions(space.robot, changed, e)
            values.append(sum(np.sum(weights[x] * np.asarray(d[x])) for x in fields))
        expected = (values[0] - values[1]) / (2 * step)
        actual = np.sum(direction * np.asarray(getattr(gradient, field)))
        np.testing.assert_allclose(actual, expected, rtol=2e-3, atol=1e-3, err_msg=field)
