"""The design map against an independent NumPy version, by hand, and through MuJoCo."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from shapebody.design.axes import published_axes, published_axes_seed
from shapebody.design.export import TIGHT_RANGE, balanced, ordered_ranges
from shapebody.design.parameters import BLOCKS, KINDS, part_label
from shapebody.design.phi import MODEL_FIELDS, Embodiment, phi
from shapebody.design.space import DesignSpace
from shapebody.robot.robot import load_robot

ROBOTS = ("unitree_go2", "mit_humanoid", "golem")
FIELDS = [field.name for field in dataclasses.fields(Embodiment)]


@pytest.fixture(scope="module")
def spaces():
    return {name: DesignSpace(load_robot(name)) for name in ROBOTS}


@pytest.fixture(scope="module")
def go2(spaces):
    return spaces["unitree_go2"]


# An independent Φ: float64, entry by entry, written from the table of formulas.


def axis_angle(axis, angle):
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * np.asarray(axis))])


def multiply(p, q):
    result = np.zeros(4)
    mujoco.mju_mulQuat(result, p, q)
    return result


def drawn_axes(robot, seed):
    generator = np.random.default_rng(seed)
    draws = (
        generator.normal(size=(robot.num_bodies, 3)),
        generator.normal(size=(robot.num_bodies, 3)),
    )
    angles = generator.uniform(0, 2 * np.pi, size=(robot.num_joints, 1))[:, 0]
    inertia, body = ([row / np.sqrt(row @ row) for row in draw] for draw in draws)
    joint = []
    for index, angle in zip(robot.joints, angles, strict=True):
        axis = robot.model.jnt_axis[index]
        k = int(np.argmin(np.abs(axis)))
        first = np.zeros(3)
        first[(k + 1) % 3] = axis[(k + 2) % 3]
        first[(k + 2) % 3] = -axis[(k + 1) % 3]
        first /= np.sqrt(first @ first)
        joint.append(np.cos(angle) * first + np.sin(angle) * np.cross(axis, first))
    return inertia, body, joint


def slow_map(robot, f, axes):
    """Φ(f) as a dict of float64 arrays."""
    model = robot.model
    entries = iter(np.asarray(f, np.float64))

    def read(*shape):
        values = np.array([next(entries) for _ in range(int(np.prod(shape)))])
        return values.reshape(shape)

    nb, nj, nu, nf = robot.num_bodies, robot.num_joints, robot.num_actuators, robot.num_feet
    size, coupled, mass, inertia = read(3), read(nb), read(nb), read(nb, 3)
    ipos, iquat, pos, quat, imu = read(nb, 3), read(nb), read(nb, 3), read(nb), read(3)
    foot, axis = read(nf, 3), read(nj)
    torque, nominal, velocity, limits = read(nu), read(nu), read(nu), read(nj, 2)
    passive = {}
    for name in ("dof_damping", "dof_armature", "jnt_stiffness", "dof_frictionloss"):
        passive[name] = read(nj), read(nj)
    p_gain, d_gain, scale = read(3)
    assert next(entries, None) is None

    s = [1 + 0.8 * size[k] for k in range(3)]
    a = (s[0] + s[1] + s[2]) / 3
    e = {name: np.array(getattr(model, name)) for name in MODEL_FIELDS}
    for b in range(nb):
        i = b + 1
        c = 1 + 0.25 * coupled[b]
        e["body_mass"][i] = model.body_mass[i] * a * a * a * c * (1 + 0.25 * mass[b])
        for k in range(3):
            e["body_inertia"][i, k] *= s[k] ** 5 * c * (1 + 0.25 * inertia[b, k])
            e["body_ipos"][i, k] = model.body_ipos[i, k] * s[k] + 0.02 * ipos[b, k]
            e["body_pos"][i, k] = model.body_pos[i, k] * s[k] + 0.02 * pos[b, k]
        e["body_iquat"][i] = multiply(axis_angle(axes[0][b], 0.2 * iquat[b]), model.body_iquat[i])
        e["body_quat"][i] = multiply(axis_angle(axes[1][b], 0.02 * quat[b]), model.body_quat[i])
    for i in range(model.nsite):
        if model.site_bodyid[i]:
            e["site_pos"][i] *= s
    e["site_pos"][robot.imu_site] += 0.1 * imu
    for i in range(model.ngeom):
        if model.geom_bodyid[i]:
            e["geom_pos"][i] *= s
            e["geom_size"][i] *= a
            e["geom_rbound"][i] *= a
    for n, i in enumerate(robot.feet):
        e["geom_size"][i] = [model.geom_size[i, k] * a * (1 + 0.75 * foot[n, k]) for k in range(3)]
        e["geom_rbound"][i] = np.linalg.norm(e["geom_size"][i])
    for n, i in enumerate(robot.joints):
        dof = model.jnt_dofadr[i]
        e["jnt_pos"][i] *= s
        turn = np.zeros(3)
        mujoco.mju_rotVecQuat(turn, model.jnt_axis[i], axis_angle(axes[2][n], 0.1 * axis[n]))
        e["jnt_axis"][i] = turn
        e["jnt_range"][i] += 0.4 * limits[n]
        for name, add in (
            ("dof_damping", 0.1),
            ("dof_armature", 0.001),
            ("jnt_stiffness", 0.1),
            ("dof_frictionloss", 1e-5),
        ):
            at = i if name == "jnt_stiffness" else dof
            factor, offset = passive[name][0][n], passive[name][1][n]
            e[name][at] = max(0, getattr(model, name)[at] * a * (1 + factor) + add * offset)
    e["nominal"], e["velocity_limits"] = np.zeros(nu), np.zeros(nu)
    e["p_gain"] = robot.p_gain * a * (1 + 0.5 * p_gain)
    e["d_gain"] = robot.d_gain * a * (1 + 0.5 * d_gain)
    e["action_scale"] = robot.action_scale * a * (1 + 0.5 * scale)
    for u in range(nu):
        tau = model.actuator_forcerange[u, 1] * a * (1 + 0.75 * torque[u])
        e["actuator_forcerange"][u] = -tau, tau
        e["actuator_gainprm"][u, 0] = e["p_gain"]
        e["actuator_biasprm"][u, 1:3] = -e["p_gain"], -e["d_gain"]
        low, high = model.jnt_range[robot.joints[robot.actuated[u]]]
        middle, half = (low + high) / 2, (high - low) / 2
        position = robot.nominal[u] + 0.1 * nominal[u]
        e["nominal"][u] = min(max(position, middle - 0.9 * half), middle + 0.9 * half)
        e["velocity_limits"][u] = robot.velocity_limits[u] * a * (1 + 0.75 * velocity[u])
    return e


def assert_embodiment(actual, expected, rtol=3e-6, atol=2e-7):
    for name in FIELDS:
        value = np.asarray(getattr(actual, name))
        assert value.dtype == np.float32, name
        np.testing.assert_allclose(value, expected[name], rtol=rtol, atol=atol, err_msg=name)


@pytest.mark.parametrize("name", ROBOTS)
def test_map_agrees_with_independent_version(spaces, name):
    space = spaces[name]
    axes = drawn_axes(space.robot, seed=0)
    for f in (space.start(1), space.start(12)):
        assert_embodiment(space(f), slow_map(space.robot, f, axes))


@pytest.mark.parametrize("name", ROBOTS)
def test_reference_is_exact(spaces, name):
    space = spaces[name]
    robot, e = space.robot, space(space.reference)
    assert space.reference.dtype == np.float32 and not space.reference.any()
    for field in MODEL_FIELDS:
        reference = getattr(robot.model, field).astype(np.float32)
        np.testing.assert_array_equal(getattr(e, field), reference, err_msg=field)
    for field in ("nominal", "velocity_limits", "p_gain", "d_gain", "action_scale"):
        reference = np.asarray(getattr(robot, field), np.float32)
        np.testing.assert_array_equal(getattr(e, field), reference, err_msg=field)


def test_order_of_the_design_vector(go2):
    offsets = [0, 3, 16, 29, 68, 107, 120, 159, 172, 175, 187, 199, 211, 223, 235, 259, 271, 283]
    offsets += [295, 307, 319, 331, 343, 355, 356, 357]
    assert [go2.slices[block.key].start for block in BLOCKS] == offsets
    assert go2.dim == go2.robot.design_dim == 358


def test_values_by_hand(go2):
    """One entry per block of the Go2; the right-hand sides are computed by hand."""

    def at(**entries):
        f = go2.reference.copy()
        for key, (offset, value) in entries.items():
            f[go2.slices[key].start + offset] = value
        return jax.tree.map(np.asarray, go2(f))

    def close(actual, expected):
        np.testing.assert_allclose(actual, expected, rtol=1e-6, atol=1e-8)

    robot = go2.robot
    hip, trunk, foot = 2, 1, robot.feet[0]
    e = at(size=(0, 0.5))  # s = (1.4, 1, 1), a = 3.4 / 3
    a = 3.4 / 3
    close(e.body_mass[trunk], 6.921 * a**3)
    close(e.body_inertia[trunk], [0.107027 * 1.4**5, 0.0980771, 0.0244531])
    close(e.body_pos[hip], [0.1934 * 1.4, 0.0465, 0])
    close(e.geom_size[foot], [0.022 * a, 0, 0])
    close(e.geom_pos[foot], [-0.002 * 1.4, 0, -0.213])
    close(e.site_pos[robot.imu_site], [-0.02557 * 1.4, 0, 0.04232])
    close(e.actuator_forcerange[0], [-23.7 * a, 23.7 * a])
    close(e.p_gain, 20 * a)
    close(e.geom_size[robot.floor], [0, 0, 0.05])
    close(e.jnt_range[1], [-1.0472, 1.0472])
    e = at(coupled_mass=(0, 1))
    close(e.body_mass[trunk], 8.65125)
    close(e.body_inertia[trunk, 0], 0.107027 * 1.25)
    e = at(mass=(1, -1))
    close(e.body_mass[hip], 0.678 * 0.75)
    close(e.body_inertia[hip, 0], 0.00088403)
    close(at(inertia=(2, -1)).body_inertia[trunk, 2], 0.0244531 * 0.75)
    close(at(ipos=(0, 1)).body_ipos[trunk, 0], 0.041112)
    turned = at(iquat=(1, 0.5)).body_iquat[hip]
    turned = multiply(turned, robot.model.body_iquat[hip] * [1, -1, -1, -1])
    close(2 * np.linalg.norm(turned[1:]), 2 * np.sin(0.05))
    close(at(pos=(3, 0.5)).body_pos[hip, 0], 0.2034)
    turned = at(quat=(1, 1)).body_quat[hip]
    np.testing.assert_allclose(turned[0], np.cos(0.01), atol=1e-7)
    close(np.linalg.norm(turned[1:]), np.sin(0.01))
    close(at(imu=(2, -1)).site_pos[robot.imu_site, 2], -0.05768)
    close(at(foot=(0, 1)).geom_size[foot, 0], 0.0385)
    close(at(foot=(0, 1)).geom_rbound[foot], 0.0385)
    close(at(axis=(0, -1)).jnt_axis[1, 0], np.cos(0.1))
    close(at(torque=(0, -1)).actuator_forcerange[0], [-5.925, 5.925])
    close(at(nominal=(0, 1)).nominal[0], 0.2)
    close(at(nominal=(2, 1)).nominal[2], -1.4)
    close(at(velocity=(0, 1)).velocity_limits[0], 52.675)
    close(at(range=(0, 1)).jnt_range[1], [-0.6472, 1.0472])
    close(at(range=(1, -1)).jnt_range[1], [-1.0472, 0.6472])
    close(at(damping=(0, 1)).dof_damping[6], 0.02)
    close(at(damping_add=(0, 1)).dof_damping[6], 0.11)
    close(at(damping_add=(0, -1)).dof_damping[6], 0)
    close(at(armature=(0, -1)).dof_armature[6], 0)
    close(at(armature_add=(0, 1)).dof_armature[6], 0.011)
    close(at(stiffness=(0, 1)).jnt_stiffness[1], 0)
    close(at(stiffness_add=(0, 1)).jnt_stiffness[1], 0.1)
    close(at(friction=(0, 1)).dof_frictionloss[6], 0.4)
    close(at(friction_add=(0, 1)).dof_frictionloss[6], 0.20001)
    e = at(p_gain=(0, 1), d_gain=(0, -1), action_scale=(0, 1))
    close(e.actuator_gainprm[:, 0], 30)
    close(e.actuator_biasprm[:, :3], np.tile([0, -30, -0.25], (12, 1)))
    close([e.p_gain, e.d_gain, e.action_scale], [30, 0.25, 0.45])


def test_nominal_positions_are_clipped_to_reference_soft_limits(go2):
    """A home position at a limit moves to the soft limit, also at f = 0."""
    robot = dataclasses.replace(go2.robot, nominal=go2.robot.nominal + 1.2)
    low, high = robot.model.jnt_range[1]
    e = DesignSpace(robot)(go2.reference)
    np.testing.assert_allclose(e.nominal[0], 0.9 * high, rtol=1e-6)
    assert e.nominal[0] < robot.nominal[0]


def test_start_designs(go2):
    expected = np.random.default_rng(3).uniform(-1, 1, 358).astype(np.float32)
    np.testing.assert_array_equal(go2.start(3), expected)
    assert go2.start(3).dtype == np.float32


def test_phi_is_a_function_of_a_reference_robot_and_a_design(go2):
    """As the space calls it, and with the reference as an argument of compiled code."""
    f = go2.start(1)
    for name, value in dataclasses.asdict(jax.jit(phi)(go2.reference_robot, f)).items():
        np.testing.assert_allclose(value, getattr(go2(f), name), rtol=1e-5, atol=1e-7)
    assert go2.reference_robot.slices == go2.slices
    with pytest.raises(ValueError, match=r"f has shape \(357,\); expected \[358\]"):
        phi(go2.reference_robot, f[1:])
    with pytest.raises(TypeError, match=r"reference is .*; expected a Reference: DesignSpace"):
        phi(go2.robot, f)


def test_axes_are_constants_of_the_space(go2):
    robot, f = go2.robot, go2.start(0)
    again, other = DesignSpace(robot), DesignSpace(robot, axes_seed=1)
    np.testing.assert_array_equal(go2(f).jnt_axis, again(f).jnt_axis)
    assert np.abs(go2(f).jnt_axis - other(f).jnt_axis).max() > 0.01


def test_published_axes(go2):
    """The published start design 0 of the Go2 was drawn with generator seed 1541157149."""
    robot, f = go2.robot, go2.start(0)
    assert published_axes_seed(f) == 1541157149
    axes = drawn_axes(robot, 1541157149)
    for actual, expected in zip(published_axes(robot, f), axes, strict=True):
        np.testing.assert_allclose(actual, expected, atol=1e-12)
    space = DesignSpace(robot, published_axes_of=f)
    assert_embodiment(space(f), slow_map(robot, f, axes))
    joint_axes = robot.model.jnt_axis[robot.joints]
    np.testing.assert_allclose(np.sum(joint_axes * space.joint_axes, axis=1), 0, atol=1e-12)


# Properties of any design.


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_any_design_is_sound(spaces, data):
    space = spaces[data.draw(st.sampled_from(ROBOTS))]
    entries = st.one_of(st.sampled_from([-1.0, 0.0, 1.0]), st.floats(-1, 1, width=32))
    f = data.draw(hnp.arrays(np.float32, space.dim, elements=entries, fill=entries))
    e = jax.tree.map(np.asarray, space(f))
    robot = space.robot
    for name in FIELDS:
        assert np.all(np.isfinite(getattr(e, name))), name
    assert np.all(e.body_mass[1:] > 0) and np.all(e.body_inertia[1:] > 0)
    used = robot.model.geom_size > 0
    assert np.all(e.geom_size[used] > 0) and np.all(e.geom_size[~used] == 0)
    for name in ("dof_damping", "dof_armature", "jnt_stiffness", "dof_frictionloss"):
        assert np.all(getattr(e, name) >= 0), name
    for name in ("body_quat", "body_iquat", "jnt_axis"):
        norms = np.linalg.norm(getattr(e, name), axis=1)
        np.testing.assert_allclose(norms, 1, atol=2e-6, err_msg=name)
    assert np.all(e.actuator_forcerange[:, 1] > 0) and np.all(e.velocity_limits > 0)
    assert min(e.p_gain, e.d_gain, e.action_scale) > 0
    low, high = robot.model.jnt_range[robot.joints[robot.actuated]].T
    assert np.all(e.nominal >= low) and np.all(e.nominal <= high)


def test_gradient_against_finite_differences(go2):
    """A weighted sum of all fields; differences are taken in float64 by the independent version."""
    robot, rng = go2.robot, np.random.default_rng(0)
    axes = drawn_axes(robot, 0)
    # Away from the kinks of max(0, .) and of the clipping.
    f = 0.05 * go2.start(5)
    weights = {name: rng.normal(size=getattr(go2(f), name).shape) for name in FIELDS}

    def scalar(f):
        e = go2(f)
        return sum(jnp.sum(weights[name] * getattr(e, name)) for name in FIELDS)

    def slow_scalar(f):
        e = slow_map(robot, f, axes)
        return sum(np.sum(weights[name] * e[name]) for name in FIELDS)

    gradient = np.asarray(jax.jit(jax.grad(scalar))(f))
    assert np.all(np.isfinite(gradient))
    f64, step = f.astype(np.float64), 1e-4
    columns = [go2.slices[block.key].start for block in BLOCKS]
    for column in columns:
        unit = step * np.eye(go2.dim)[column]
        expected = (slow_scalar(f64 + unit) - slow_scalar(f64 - unit)) / (2 * step)
        np.testing.assert_allclose(gradient[column], expected, rtol=2e-4, atol=1e-6)


def test_gradients_are_finite_at_reference_and_corners(go2):
    gradient = jax.jit(jax.grad(lambda f: sum(jnp.sum(x) for x in jax.tree.leaves(go2(f)))))
    for f in (go2.reference, go2.reference + 1, go2.reference - 1):
        assert np.all(np.isfinite(gradient(f)))


def test_batches_and_transformations_agree(go2):
    designs = np.stack([go2.start(seed) for seed in range(4)]).reshape(2, 2, -1)
    batch = go2(designs)
    jitted = jax.jit(go2)(designs)
    mapped = jax.vmap(jax.vmap(go2))(designs)
    for name in FIELDS:
        single = np.asarray(getattr(go2(designs[1, 0]), name))
        for other in (batch, jitted, mapped):
            value = np.asarray(getattr(other, name))[1, 0]
            np.testing.assert_allclose(value, single, rtol=1e-6, atol=1e-8, err_msg=name)


# The parameter table.


@pytest.mark.parametrize("name", ROBOTS)
def test_parameters_and_groups(spaces, name):
    space = spaces[name]
    parameters = space.parameters
    assert [p.index for p in parameters] == list(range(space.dim))
    assert len({p.name for p in parameters}) == space.dim
    assert list(space.groups)[: len(KINDS)] == list(KINDS)
    assert list(space.groups)[-2:] == ["Trunk", "Global"] == list(space.parts)[-2:]
    for labels in (KINDS, space.parts):
        together = np.concatenate([space.groups[label] for label in labels])
        np.testing.assert_array_equal(np.sort(together), np.arange(space.dim))
    assert all(p.low <= p.high for p in parameters)


def test_parameter_labels(go2):
    by_name = {p.name: p for p in go2.parameters}
    limit = by_name["FL calf torque limit"]
    assert (limit.kind, limit.part, limit.unit) == ("Torque limit", "FL_calf_joint", "N m")
    np.testing.assert_allclose([limit.low, limit.high], [45.43 * 0.25, 45.43 * 1.75])
    assert by_name["Trunk IMU position x"].part == "trunk"
    assert by_name["Size x"].part == "global"
    assert part_label("coxa_joint_RR") == "Coxa RR"
    shared = go2.groups["FL calf"]
    assert {go2.parameters[i].part for i in shared} == {"FL_calf", "FL_calf_joint"}


def test_parameter_ranges_are_those_of_the_map(go2):
    """low and high of every parameter, against Φ at ±1 with all other entries 0."""
    robot = go2.robot
    joints, dofs = robot.joints, robot.model.jnt_dofadr[robot.joints]
    values = {
        "coupled_mass": lambda e: e.body_mass[:, 1:],
        "mass": lambda e: e.body_mass[:, 1:],
        "inertia": lambda e: e.body_inertia[:, 1:],
        "ipos": lambda e: e.body_ipos[:, 1:],
        "pos": lambda e: e.body_pos[:, 1:],
        "imu": lambda e: e.site_pos[:, robot.imu_site],
        "foot": lambda e: e.geom_size[:, robot.feet],
        "torque": lambda e: e.actuator_forcerange[:, :, 1],
        "nominal": lambda e: e.nominal,
        "velocity": lambda e: e.velocity_limits,
        "range": lambda e: e.jnt_range[:, joints],
        "damping": lambda e: e.dof_damping[:, dofs],
        "armature": lambda e: e.dof_armature[:, dofs],
        "stiffness": lambda e: e.jnt_stiffness[:, joints],
        "friction": lambda e: e.dof_frictionloss[:, dofs],
        "p_gain": lambda e: e.p_gain,
        "d_gain": lambda e: e.d_gain,
        "action_scale": lambda e: e.action_scale,
    }
    for sign, end in ((-1, "low"), (1, "high")):
        e = jax.tree.map(np.asarray, go2(sign * np.eye(go2.dim, dtype=np.float32)))
        for key, read in values.items():
            for block in (key, key + "_add"):
                if block not in go2.slices:
                    continue
                where = np.arange(go2.dim)[go2.slices[block]]
                rows = read(e).reshape(go2.dim, -1)[where]
                listed = [getattr(go2.parameters[i], end) for i in where]
                np.testing.assert_allclose(np.diag(rows), listed, rtol=1e-6, atol=1e-8)


# Validation.


def test_validation_names_value_expectation_and_fix(go2):
    good = go2.start(0)
    np.testing.assert_array_equal(go2.validate(list(good)), good)
    with pytest.raises(ValueError, match=r"shape \(357,\), expected \[..., 358\].*start"):
        go2.validate(good[:-1])
    with pytest.raises(ValueError, match="design is 'abc'; expected an array of numbers, 358"):
        go2.validate("abc")
    with pytest.raises(ValueError, match=r"shape \(357,\), expected \[..., 358\]"):
        go2(good[:-1])
    with pytest.raises(ValueError, match=r"entry \(7,\) is nan.*finite"):
        go2.validate(np.where(np.arange(358) == 7, np.nan, good))
    with pytest.raises(ValueError, match=r"entry \(1, 9\) is 1.5, expected \[-1, 1\].*clip"):
        go2.validate(np.stack([good, np.where(np.arange(358) == 9, 1.5, good)]))
    with pytest.raises(ValueError, match="expected one design"):
        go2.to_model(np.stack([good, good]))
    with pytest.raises(ValueError, match="expected one design"):
        DesignSpace(go2.robot, published_axes_of=np.stack([good, good]))


# Models and MJCF.


@pytest.mark.parametrize("name", ROBOTS)
def test_model_holds_the_design(spaces, name):
    space = spaces[name]
    robot, f = space.robot, space.start(2)
    before = {field: getattr(robot.model, field).copy() for field in MODEL_FIELDS}
    model, e = space.to_model(f), space(f)
    for field in MODEL_FIELDS:
        np.testing.assert_array_equal(getattr(model, field), getattr(e, field), err_msg=field)
        np.testing.assert_array_equal(getattr(robot.model, field), before[field])
    assert not model.body_sameframe.any() and not model.geom_sameframe.any()
    for field in ("body_invweight0", "dof_invweight0", "body_subtreemass", "geom_quat"):
        np.testing.assert_array_equal(getattr(model, field), getattr(robot.model, field))
    np.testing.assert_allclose(model.numeric("action_scale").data, e.action_scale)
    np.testing.assert_allclose(model.numeric("velocity_limits").data, e.velocity_limits)
    s = 1 + 0.8 * f[:3]
    track = model.camera("track").id
    np.testing.assert_allclose(model.cam_pos[track], robot.model.cam_pos[track] * s, rtol=1e-6)


def test_balanced_inertias():
    inertia = np.array([[1.0, 2.0, 2.5], [1.0, 1.0, 4.0], [3.0, 1.0, 2.0]])
    expected = [[1, 2, 2.5], [2, 2, 2], [3, 1, 2]]
    np.testing.assert_array_equal(balanced(inertia), expected)


def exported(space, f):
    """The compiled MJCF, and the model of `to_model` with what compiling changes."""
    text = space.to_mjcf(f)
    expected = space.to_model(f)
    moments = balanced(expected.body_inertia)
    changed = int(np.any(moments != expected.body_inertia, axis=1).sum())
    assert f"Inertias of {changed} of {space.robot.num_bodies} bodies" in text.splitlines()[0]
    expected.body_inertia[:] = moments
    mujoco.mj_setConst(expected, mujoco.MjData(expected))
    return text, mujoco.MjModel.from_xml_string(text), expected


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("seed", [None, 0, 4])
def test_mjcf_compiles_to_the_design_and_simulates_the_same(spaces, name, seed):
    space = spaces[name]
    f = space.reference if seed is None else space.start(seed)
    _, compiled, expected = exported(space, f)
    fields = (*MODEL_FIELDS, "geom_quat", "site_size", "numeric_data", "key_qpos", "key_ctrl")
    fields += ("body_invweight0", "dof_invweight0", "pair_friction", "cam_pos")
    for field in fields:
        value, wanted = getattr(compiled, field), getattr(expected, field)
        np.testing.assert_allclose(value, wanted, rtol=2e-6, atol=1e-8, err_msg=field)
    if seed is None:
        return
    states = []
    for model in (compiled, expected):
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
        data.qpos[2] += 0.01  # not exactly at touch, where rounding decides about a contact
        for _ in range(200):
            mujoco.mj_step(model, data)
        states.append(data.qpos.copy())
    assert np.all(np.isfinite(states[1]))
    np.testing.assert_allclose(states[0], states[1], atol=1e-4)


@pytest.mark.parametrize("name", ROBOTS)
def test_exported_robot_loads_and_stands(spaces, name, tmp_path):
    space = spaces[name]
    f = space.start(6)
    path = tmp_path / "design.xml"
    path.write_text(space.to_mjcf(f), encoding="utf-8")
    robot, e = load_robot(path), space(f)
    np.testing.assert_allclose(robot.nominal, e.nominal, rtol=1e-6)
    np.testing.assert_allclose(robot.velocity_limits, e.velocity_limits, rtol=1e-6)
    np.testing.assert_allclose(robot.action_scale, e.action_scale, rtol=1e-6)
    np.testing.assert_array_equal(robot.keep_nominal, space.robot.keep_nominal)
    np.testing.assert_array_equal(robot.model.sensor_type, space.robot.model.sensor_type)
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.home
    mujoco.mj_forward(robot.model, data)
    lowest = np.inf
    for geom in robot.feet:
        corner = robot.model.geom_size[geom]
        if robot.model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE:
            lowest = min(lowest, data.geom_xpos[geom, 2] - corner[0])
        else:
            for signs in np.ndindex(2, 2, 2):
                point = data.geom_xmat[geom].reshape(3, 3) @ (corner * (2 * np.array(signs) - 1))
                lowest = min(lowest, data.geom_xpos[geom, 2] + point[2])
    assert abs(lowest) < 1e-6


def narrow_go2(tmp_path):
    """A Go2 whose first joint moves by 0.6 rad only, so that designs can cross its limits."""
    text = load_robot("unitree_go2").xml.replace('range="-1.0472 1.0472"', 'range="-0.3 0.3"', 1)
    path = tmp_path / "narrow.xml"
    path.write_text(text, encoding="utf-8")
    return DesignSpace(load_robot(path))


def test_crossed_joint_limits(tmp_path):
    """Crossed limits: both act in C MuJoCo; the exported joint is held at their midpoint."""
    space = narrow_go2(tmp_path)
    f = space.reference.copy()
    f[space.slices["range"]][:2] = 1, -0.8
    joint = space.robot.joints[0]
    model = space.to_model(f)
    np.testing.assert_allclose(model.jnt_range[joint], [0.1, -0.02], atol=1e-6)
    data = mujoco.MjData(model)
    data.qpos[:] = space.robot.home
    data.qpos[2] = 10
    data.qpos[space.robot.qpos_index[0]] = 0.04
    mujoco.mj_forward(model, data)
    limits = data.efc_type == mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT
    assert np.sum(limits & (data.efc_id == joint)) == 2

    text = space.to_mjcf(f)
    assert "Limits of 1 joints had crossed" in text
    compiled = mujoco.MjModel.from_xml_string(text)
    expected = [0.04 - TIGHT_RANGE, 0.04 + TIGHT_RANGE]
    np.testing.assert_allclose(compiled.jnt_range[joint], expected, atol=1e-6)
    assert compiled.jnt_limited[joint]


def test_ordered_ranges():
    ranges = np.array([[-1.0, 1.0], [0.3, 0.1], [0.5, 0.5]])
    ordered = ordered_ranges(ranges)
    np.testing.assert_array_equal(ordered[0], ranges[0])
    assert np.all(ordered[:, 0] < ordered[:, 1])
    np.testing.assert_allclose(ordered.mean(axis=1), ranges.mean(axis=1))
