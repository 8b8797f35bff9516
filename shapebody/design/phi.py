"""The design map Φ: from a design f to an embodiment (Section 3, Appendix A)."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from shapebody.arguments import require_array, require_integer, require_kind, single
from shapebody.design.parameters import BLOCKS
from shapebody.robot.robot import Robot, require_robot
from shapebody.rotations import quaternion_product


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Embodiment:
    """A robot's physical and control parameters e = Φ(f), float32, in SI units and radians.

    The first part has the names, shapes and order of MuJoCo model fields (world body, floor and
    free joint included), so that an engine can copy it field by field.
    """

    body_mass: jax.Array  # [nbody] kg
    body_inertia: jax.Array  # [nbody, 3] principal moments, kg m²
    body_ipos: jax.Array  # [nbody, 3] centre of mass in the body frame, m
    body_iquat: jax.Array  # [nbody, 4]
    body_pos: jax.Array  # [nbody, 3] in the parent frame, m
    body_quat: jax.Array  # [nbody, 4]
    site_pos: jax.Array  # [nsite, 3] m
    geom_pos: jax.Array  # [ngeom, 3] m
    geom_size: jax.Array  # [ngeom, 3] m
    geom_rbound: jax.Array  # [ngeom] radius of the bounding sphere, m
    jnt_pos: jax.Array  # [njnt, 3] m
    jnt_axis: jax.Array  # [njnt, 3] unit vectors
    jnt_range: jax.Array  # [njnt, 2] rad
    jnt_stiffness: jax.Array  # [njnt] N m/rad
    dof_damping: jax.Array  # [nv] N m s/rad
    dof_armature: jax.Array  # [nv] kg m²
    dof_frictionloss: jax.Array  # [nv] N m
    actuator_forcerange: jax.Array  # [nu, 2] N m
    actuator_gainprm: jax.Array  # [nu, ...]
    actuator_biasprm: jax.Array  # [nu, ...]
    nominal: jax.Array  # [nu] nominal joint positions, rad
    velocity_limits: jax.Array  # [nu] rad/s
    p_gain: jax.Array  # [] N m/rad
    d_gain: jax.Array  # [] N m s/rad
    action_scale: jax.Array  # [] rad


CONTROL_FIELDS = ("nominal", "velocity_limits", "p_gain", "d_gain", "action_scale")

MODEL_FIELDS = tuple(
    field.name for field in dataclasses.fields(Embodiment) if field.name not in CONTROL_FIELDS
)


def rotation_axes(generator: np.random.Generator, joint_axes: np.ndarray, num_bodies: int):
    """Directions of the rotations in Φ, drawn from `generator`.

    Returns unit vectors (inertia [nb, 3], body [nb, 3], joint [nj, 3]), the last perpendicular to
    the reference `joint_axes` [nj, 3].
    """

    require_kind("generator", generator, np.random.Generator, "numpy.random.default_rng(0)")
    joint_axes = require_array("joint_axes", joint_axes, ("nj", 3))
    require_integer("num_bodies", num_bodies, 1, 10**6)

    def normalized(vectors):
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)

    inertia = normalized(generator.normal(size=(num_bodies, 3)))
    body = normalized(generator.normal(size=(num_bodies, 3)))
    angle = generator.uniform(0, 2 * np.pi, size=(len(joint_axes), 1))
    rows = np.arange(len(joint_axes))
    smallest = np.argmin(np.abs(joint_axes), axis=1)
    following, last = (smallest + 1) % 3, (smallest + 2) % 3
    first = np.zeros_like(joint_axes)
    first[rows, following] = joint_axes[rows, last]
    first[rows, last] = -joint_axes[rows, following]
    first = normalized(first)
    joint = np.cos(angle) * first + np.sin(angle) * np.cross(joint_axes, first)
    return inertia, body, joint


def published_axes_seed(f) -> int:
    """The generator seed that the published designs derive from their own f [d] (float32)."""
    f = require_array("f", single(require_array("f", f)))
    total = abs(float(np.sum(f.astype(np.float64))))
    return int(total * 1e6) ^ 0x5A5A5A5A


def published_axes(robot: Robot, f):
    """Rotation axes (inertia, body, joint) that the published design f [d] was built with."""
    require_array("f", f, (require_robot(robot).design_dim,))
    generator = np.random.default_rng(published_axes_seed(f))
    return rotation_axes(generator, robot.model.jnt_axis[robot.joints], robot.num_bodies)


def _turned(quaternions, axis, angle):
    """Quaternions [n, 4] after rotations by `angle` [n] about unit vectors `axis` [n, 3]."""
    half = 0.5 * angle
    turn = jnp.concatenate([jnp.cos(half)[None], jnp.sin(half) * axis.T])
    return quaternion_product(turn, quaternions.T).T


def phi(constants: dict, slices: dict[str, slice], f) -> Embodiment:
    """Φ for one design f [d]: formulas of the 26 blocks."""
    c = constants
    entries = {}
    for block in BLOCKS:
        entry = f[slices[block.key]]
        components = len(block.components)
        entries[block.key] = entry.reshape(-1, components) if components > 1 else entry
    x = {block.key: block.range * entries[block.key] for block in BLOCKS}

    s = 1 + x["size"][0]
    a = 1 + jnp.mean(x["size"])  # the mean of s, exactly 1 at the reference

    def with_world(name, values):
        return jnp.concatenate([c[name][:1], values])

    coupled = 1 + x["coupled_mass"]
    mass = c["body_mass"][1:] * a**3 * coupled * (1 + x["mass"])
    inertia = c["body_inertia"][1:] * s**5 * coupled[:, None] * (1 + x["inertia"])
    iquat = _turned(c["body_iquat"][1:], c["inertia_axes"], x["iquat"])
    quat = _turned(c["body_quat"][1:], c["body_axes"], x["quat"])

    on_robot = c["geom_on_robot"] > 0
    geom_scale = jnp.where(on_robot, a, 1)
    # One-hot sums instead of scatters: exact, and faster in a batch on a CPU.
    foot_scale = 1 + jnp.sum(c["feet"][:, :, None] * x["foot"], axis=1)
    geom_size = c["geom_size"] * geom_scale[:, None] * foot_scale
    # The bounding radius of a sphere or a box is the norm of its size; written relative to the
    # reference, so that f = 0 gives exactly that.
    stretch = jnp.sqrt(1 + jnp.sum(c["size_share"] * (foot_scale**2 - 1), axis=1))
    rbound = c["geom_rbound"] * geom_scale * stretch

    site_on_robot = c["site_on_robot"][:, None] > 0

    cosine, sine = jnp.cos(x["axis"])[:, None], jnp.sin(x["axis"])[:, None]
    axis = cosine * c["jnt_axis"][1:] + sine * c["axis_directions"]

    def passive(reference, key):
        return jnp.maximum(0, reference * a * (1 + x[key]) + x[key + "_add"])

    def scaled(key):
        return c[key] * a * (1 + x[key])

    def joints_of(name, key):
        return jnp.concatenate([c[name][:6], passive(c[name][6:], key)])

    limits = c["soft_limits"]
    nominal = jnp.clip(c["nominal"] + x["nominal"], limits[:, 0], limits[:, 1])
    torque = scaled("torque")
    p_gain = scaled("p_gain")[0]
    d_gain = scaled("d_gain")[0]
    num_actuators = len(c["torque"])
    p_column = jnp.broadcast_to(p_gain, (num_actuators, 1))
    d_column = jnp.broadcast_to(d_gain, (num_actuators, 1))
    gain, bias = c["actuator_gainprm"], c["actuator_biasprm"]

    return Embodiment(
        body_mass=with_world("body_mass", mass),
        body_inertia=with_world("body_inertia", inertia),
        body_ipos=with_world("body_ipos", c["body_ipos"][1:] * s + x["ipos"]),
        body_iquat=with_world("body_iquat", iquat),
        body_pos=with_world("body_pos", c["body_pos"][1:] * s + x["pos"]),
        body_quat=with_world("body_quat", quat),
        site_pos=c["site_pos"] * jnp.where(site_on_robot, s, 1) + c["imu"] * x["imu"],
        geom_pos=c["geom_pos"] * jnp.where(on_robot[:, None], s, 1),
        geom_size=geom_size,
        geom_rbound=rbound,
        jnt_pos=with_world("jnt_pos", c["jnt_pos"][1:] * s),
        jnt_axis=with_world("jnt_axis", axis),
        jnt_range=with_world("jnt_range", c["jnt_range"][1:] + x["range"]),
        jnt_stiffness=with_world("jnt_stiffness", passive(c["jnt_stiffness"][1:], "stiffness")),
        dof_damping=joints_of("dof_damping", "damping"),
        dof_armature=joints_of("dof_armature", "armature"),
        dof_frictionloss=joints_of("dof_frictionloss", "friction"),
        actuator_forcerange=jnp.stack([-torque, torque], axis=-1),
        actuator_gainprm=jnp.concatenate([p_column, gain[:, 1:]], axis=1),
        actuator_biasprm=jnp.concatenate([bias[:, :1], -p_column, -d_column, bias[:, 3:]], axis=1),
        nominal=nominal,
        velocity_limits=scaled("velocity"),
        p_gain=p_gain,
        d_gain=d_gain,
        action_scale=scaled("action_scale")[0],
    )
