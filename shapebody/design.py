"""The design space: the map Φ from a normalized vector f in [-1, 1]^d to an embodiment.

One number per continuous property of a robot, in 26 blocks (`BLOCKS`) of fixed order. f = 0 is the
reference robot. Φ is smooth in f (up to clipping), so that ∂V/∂f can follow ∂V/∂Φ(f).
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from shapebody.mjcf import build_model, write_mjcf
from shapebody.robots import Robot

SOFT_LIMIT = 0.9  # soft limits span this fraction of a joint's range, about its midpoint


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


class Block(NamedTuple):
    """One block of the design vector: one entry per `over` and component."""

    key: str
    title: str
    kind: str
    over: str  # "global", "body", "joint", "actuator" or "foot"
    components: tuple[str, ...]
    range: float  # range constant R, the relative or absolute change at f = 1
    unit: str

    @property
    def adds(self) -> bool:
        """Whether an entry adds R f, in `unit`, instead of multiplying by 1 + R f."""
        offsets = ("ipos", "iquat", "pos", "quat", "imu", "axis", "nominal", "range")
        return self.key in offsets or self.key.endswith("_add")


XYZ = ("x", "y", "z")
BLOCKS = (
    Block("size", "size", "Body geometry", "global", XYZ, 0.8, ""),
    Block("coupled_mass", "mass and inertia", "Mass", "body", ("",), 0.25, "kg"),
    Block("mass", "mass", "Mass", "body", ("",), 0.25, "kg"),
    Block("inertia", "inertia", "Inertia", "body", XYZ, 0.25, "kg m²"),
    Block("ipos", "center of mass", "Center of mass", "body", XYZ, 0.02, "m"),
    Block("iquat", "inertia orientation", "Inertia", "body", ("",), 0.2, "rad"),
    Block("pos", "position", "Body geometry", "body", XYZ, 0.02, "m"),
    Block("quat", "orientation", "Body geometry", "body", ("",), 0.02, "rad"),
    Block("imu", "IMU position", "Body geometry", "global", XYZ, 0.1, "m"),
    Block("foot", "size", "Foot geometry", "foot", XYZ, 0.75, "m"),
    Block("axis", "joint axis", "Joint axis", "joint", ("",), 0.1, "rad"),
    Block("torque", "torque limit", "Torque limit", "actuator", ("",), 0.75, "N m"),
    Block("nominal", "nominal position", "Nominal position", "actuator", ("",), 0.1, "rad"),
    Block("velocity", "velocity limit", "Velocity limit", "actuator", ("",), 0.75, "rad/s"),
    Block("range", "joint range", "Joint range", "joint", ("lower", "upper"), 0.4, "rad"),
    Block("damping", "damping", "Damping", "joint", ("factor",), 1.0, "N m s/rad"),
    Block("damping_add", "damping", "Damping", "joint", ("offset",), 0.1, "N m s/rad"),
    Block("armature", "armature", "Armature", "joint", ("factor",), 1.0, "kg m²"),
    Block("armature_add", "armature", "Armature", "joint", ("offset",), 0.001, "kg m²"),
    Block("stiffness", "stiffness", "Stiffness", "joint", ("factor",), 1.0, "N m/rad"),
    Block("stiffness_add", "stiffness", "Stiffness", "joint", ("offset",), 0.1, "N m/rad"),
    Block("friction", "friction loss", "Friction loss", "joint", ("factor",), 1.0, "N m"),
    Block("friction_add", "friction loss", "Friction loss", "joint", ("offset",), 1e-5, "N m"),
    Block("p_gain", "P gain", "P gain", "global", ("",), 0.5, "N m/rad"),
    Block("d_gain", "D gain", "D gain", "global", ("",), 0.5, "N m s/rad"),
    Block("action_scale", "action scale", "Action scale", "global", ("",), 0.5, "rad"),
)

# Rows of the paper's figure of grouped design changes, from top to bottom.
KINDS = (
    "P gain",
    "D gain",
    "Action scale",
    "Torque limit",
    "Velocity limit",
    "Nominal position",
    "Joint range",
    "Damping",
    "Armature",
    "Stiffness",
    "Friction loss",
    "Joint axis",
    "Mass",
    "Inertia",
    "Center of mass",
    "Body geometry",
    "Foot geometry",
)


@dataclass(frozen=True)
class Parameter:
    """One entry of the design vector.

    `low` and `high` are the physical value at f = -1 and f = +1 with all other entries 0 (for
    rotations the angle; for `size` the scale factor). `part` is the name of the body, joint,
    actuator or foot geom, or "global"; `kind` is the row of the paper's heatmap.
    """

    index: int
    name: str
    kind: str
    part: str
    component: str
    low: float
    high: float
    unit: str


def part_label(name: str) -> str:
    """A readable label of a body, joint, actuator or foot: "FL_calf_joint" -> "FL calf"."""
    words = [word for word in name.replace("-", "_").split("_") if word and word != "joint"]
    label = " ".join(words) or name
    return label[0].upper() + label[1:]


def soft_limits(joint_range):
    """Soft limits [..., 2] of joint ranges [..., 2]: the midpoint ± 0.9 of the half range."""
    low, high = joint_range[..., 0], joint_range[..., 1]
    middle, half = 0.5 * (low + high), 0.5 * SOFT_LIMIT * (high - low)
    stack = jnp.stack if isinstance(joint_range, jax.Array) else np.stack
    return stack([middle - half, middle + half], axis=-1)


def rotation_axes(generator: np.random.Generator, joint_axes: np.ndarray, num_bodies: int):
    """Directions of the rotations in Φ, drawn from `generator`.

    Returns unit vectors (inertia [nb, 3], body [nb, 3], joint [nj, 3]), the last perpendicular to
    the reference `joint_axes` [nj, 3].
    """

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
    total = abs(float(np.sum(np.asarray(f, np.float32).astype(np.float64))))
    return int(total * 1e6) ^ 0x5A5A5A5A


def published_axes(robot: Robot, f):
    """Rotation axes (inertia, body, joint) that the published design f [d] was built with."""
    generator = np.random.default_rng(published_axes_seed(f))
    return rotation_axes(generator, robot.model.jnt_axis[robot.joints], robot.num_bodies)


def _rotation(axis, angle):
    """Unit quaternions [n, 4] of rotations by `angle` [n] about unit vectors `axis` [n, 3]."""
    half = 0.5 * angle[:, None]
    return jnp.concatenate([jnp.cos(half), jnp.sin(half) * axis], axis=-1)


def quaternion_product(p, q):
    """Product p ⊗ q of quaternions [..., 4], scalar part first."""
    pw, px, py, pz = (p[..., k] for k in range(4))
    qw, qx, qy, qz = (q[..., k] for k in range(4))
    return jnp.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=-1,
    )


class DesignSpace:
    """The design space of one robot: f in [-1, 1]^d and the differentiable map Φ.

    The directions of the small rotations (inertia frames, body frames, joint axes) are not part of
    f. They are constants of the space, drawn from `axes_seed`; with `published_axes_of=f` they are
    those with which the published design f was built.

    `space(f)` maps float32 f [..., d] to an `Embodiment` with the same leading axes, and can be
    jitted, vmapped and differentiated. It checks the length of f only; `validate` checks values.

    Φ clips damping, armature, stiffness and friction loss at 0 and nominal positions to the soft
    limits of the reference joint ranges (also at f = 0), and nothing else: principal inertias
    mostly violate the triangle inequality, a joint's range may exclude its nominal position, and
    narrow ranges may have lower > upper. Physics takes all of that as it is; for MJCF see
    `to_mjcf`.
    """

    def __init__(self, robot: Robot, axes_seed: int = 0, published_axes_of=None):
        self.robot = robot
        counts = {
            "global": 1,
            "body": robot.num_bodies,
            "joint": robot.num_joints,
            "actuator": robot.num_actuators,
            "foot": robot.num_feet,
        }
        self.slices: dict[str, slice] = {}
        offset = 0
        for block in BLOCKS:
            length = counts[block.over] * len(block.components)
            self.slices[block.key] = slice(offset, offset + length)
            offset += length
        self.dim = offset
        self.reference = np.zeros(self.dim, np.float32)
        if published_axes_of is None:
            generator = np.random.default_rng(axes_seed)
            axes = rotation_axes(generator, robot.model.jnt_axis[robot.joints], robot.num_bodies)
        else:
            axes = published_axes(robot, self._one(published_axes_of))
        self.inertia_axes, self.body_axes, self.joint_axes = axes
        self._check_layout()
        self._jitted = jax.jit(functools.partial(_embodiment, self._constants(), self.slices))

    def _check_layout(self):
        model, robot = self.robot.model, self.robot
        hinges = np.arange(1, model.njnt)
        if (
            model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE
            or not np.array_equal(robot.joints, hinges)
            or not np.all(model.jnt_type[hinges] == mujoco.mjtJoint.mjJNT_HINGE)
        ):
            raise ValueError(
                f"robot {robot.name!r} must have one free joint first and hinge joints after it; "
                "fix its MJCF: one floating trunk, hinges elsewhere"
            )

    def __repr__(self):
        return f"DesignSpace({self.robot.name!r}, dim={self.dim})"

    def start(self, seed: int) -> np.ndarray:
        """Start design number `seed` of the paper: float32 [d], uniform in [-1, 1]."""
        return np.random.default_rng(seed).uniform(-1, 1, self.dim).astype(np.float32)

    def validate(self, f) -> np.ndarray:
        """Return f as float32 [..., d]; ValueError if its length, finiteness or box is wrong."""
        f = np.asarray(f, np.float32)
        self._check_length(f)
        if not np.all(np.isfinite(f)):
            where = np.argwhere(~np.isfinite(f))[0]
            raise ValueError(
                f"design entry {tuple(map(int, where))} is {f[tuple(where)]}, expected a finite "
                "number; replace non-finite entries before using the design"
            )
        if np.any(np.abs(f) > 1):
            where = np.unravel_index(np.argmax(np.abs(f)), f.shape)
            raise ValueError(
                f"design entry {tuple(map(int, where))} is {f[where]}, expected [-1, 1]; "
                "clip the design with numpy.clip(f, -1, 1)"
            )
        return f

    def _check_length(self, f):
        if f.ndim == 0 or f.shape[-1] != self.dim:
            raise ValueError(
                f"design has shape {f.shape}, expected [..., {self.dim}] for robot "
                f"{self.robot.name!r}; use a design of this robot, such as space.start(0)"
            )

    def __call__(self, f) -> Embodiment:
        """Φ(f): embodiment of designs f [..., d]."""
        f = jnp.asarray(f, jnp.float32)
        self._check_length(f)
        function = self._jitted
        for _ in range(f.ndim - 1):
            function = jax.vmap(function)
        return function(f)

    def _constants(self) -> dict:
        """Reference values of the robot and constants of Φ, as float32 arrays."""
        robot, model = self.robot, self.robot.model
        feet = np.zeros((model.ngeom, robot.num_feet))
        feet[robot.feet, np.arange(robot.num_feet)] = 1
        squares = model.geom_size**2
        size_share = squares / np.maximum(squares.sum(axis=1, keepdims=True), 1e-30)
        imu = np.zeros((model.nsite, 1))
        imu[robot.imu_site] = 1
        constants = {name: getattr(model, name) for name in MODEL_FIELDS}
        constants.update(
            nominal=robot.nominal,
            soft_limits=soft_limits(model.jnt_range[robot.joints[robot.actuated]]),
            velocity=robot.velocity_limits,
            torque=model.actuator_forcerange[:, 1],
            p_gain=robot.p_gain,
            d_gain=robot.d_gain,
            action_scale=robot.action_scale,
            inertia_axes=self.inertia_axes,
            body_axes=self.body_axes,
            axis_directions=np.cross(self.joint_axes, model.jnt_axis[robot.joints]),
            geom_on_robot=model.geom_bodyid > 0,
            site_on_robot=model.site_bodyid > 0,
            feet=feet,
            size_share=size_share,
            imu=imu,
        )
        return {name: np.asarray(value, np.float32) for name, value in constants.items()}

    @functools.cached_property
    def parameters(self) -> list[Parameter]:
        """The d parameters in the order of f."""
        return _parameters(self)

    @functools.cached_property
    def groups(self) -> dict[str, np.ndarray]:
        """Indices into f by label: first every parameter type of `KINDS`, then every body part.

        Types partition f, and so do parts (`parts`): bodies, joints, actuators and feet under their
        `part_label` in alphabetical order, then "Trunk" and "Global". As in the paper's figure;
        a joint and a body of the same label share a part.
        """
        kinds: dict[str, list[int]] = {kind: [] for kind in KINDS}
        parts: dict[str, list[int]] = {}
        for parameter in self.parameters:
            kinds[parameter.kind].append(parameter.index)
            parts.setdefault(part_label(parameter.part), []).append(parameter.index)
        ordered = {label: parts[label] for label in self._order_parts(parts)}
        return {label: np.array(index) for label, index in (kinds | ordered).items()}

    @property
    def parts(self) -> tuple[str, ...]:
        """Labels of `groups` that are body parts."""
        return tuple(label for label in self.groups if label not in KINDS)

    def _order_parts(self, labels):
        trunk = part_label(_name(self.robot.model, "body", self.robot.trunk))
        last = {trunk: 1, "Global": 2}
        return sorted(labels, key=lambda label: (last.get(label, 0), label))

    def to_model(self, f) -> mujoco.MjModel:
        """A new model of design f [d], with the raw inertias of Φ, as the C engine simulates it.

        Also scales what is only looked at (site sizes, cameras) and puts the design into the home
        keyframe and the custom entries. Derived constants stay at the reference. The "same frame"
        flags are cleared: they would let MuJoCo ignore the changed frames of bodies and geoms.
        """
        return build_model(self.robot, *self._single(f))

    def to_mjcf(self, f) -> str:
        """MJCF text of design f [d] that compiles in any MuJoCo.

        It simulates as `to_model(f)` would with equally balanced inertias and recomputed derived
        constants: MJCF cannot hold inertias that violate the triangle inequality, so these become
        their mean, and a comment at the top says how many did. See `shapebody.mjcf.write_mjcf`.
        """
        return write_mjcf(self.robot, *self._single(f))

    def _single(self, f) -> tuple[Embodiment, np.ndarray]:
        """Embodiment and size factors (s_x, s_y, s_z) of one design."""
        f = self._one(f)
        return self(f), 1 + BLOCKS[0].range * f[self.slices["size"]]

    def _one(self, f) -> np.ndarray:
        f = self.validate(f)
        if f.ndim != 1:
            raise ValueError(
                f"design has shape {f.shape}, expected one design [{self.dim}]; "
                "take the designs of a batch one by one"
            )
        return f


def _embodiment(constants: dict, slices: dict[str, slice], f) -> Embodiment:
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
    iquat = quaternion_product(_rotation(c["inertia_axes"], x["iquat"]), c["body_iquat"][1:])
    quat = quaternion_product(_rotation(c["body_axes"], x["quat"]), c["body_quat"][1:])

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


def _name(model: mujoco.MjModel, over: str, index: int) -> str:
    kind = {
        "body": mujoco.mjtObj.mjOBJ_BODY,
        "joint": mujoco.mjtObj.mjOBJ_JOINT,
        "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
        "foot": mujoco.mjtObj.mjOBJ_GEOM,
    }[over]
    return mujoco.mj_id2name(model, kind, int(index)) or f"{over}_{index}"


def _parameters(space: DesignSpace) -> list[Parameter]:
    """The table of parameters, with their physical ranges when all others are at the reference."""
    robot, model = space.robot, space.robot.model
    trunk = _name(model, "body", robot.trunk)
    ids = {
        "global": [None],
        "body": range(1, model.nbody),
        "joint": robot.joints,
        "actuator": range(model.nu),
        "foot": robot.feet,
    }
    dofs = model.jnt_dofadr[robot.joints]
    references = {
        "size": np.ones(3),
        "coupled_mass": model.body_mass[1:],
        "mass": model.body_mass[1:],
        "inertia": model.body_inertia[1:],
        "ipos": model.body_ipos[1:],
        "pos": model.body_pos[1:],
        "imu": model.site_pos[robot.imu_site],
        "foot": model.geom_size[robot.feet],
        "torque": model.actuator_forcerange[:, 1],
        "nominal": robot.nominal,
        "velocity": robot.velocity_limits,
        "range": model.jnt_range[robot.joints],
        "damping": model.dof_damping[dofs],
        "armature": model.dof_armature[dofs],
        "stiffness": model.jnt_stiffness[robot.joints],
        "friction": model.dof_frictionloss[dofs],
        "p_gain": np.array([robot.p_gain]),
        "d_gain": np.array([robot.d_gain]),
        "action_scale": np.array([robot.action_scale]),
    }
    limits = soft_limits(model.jnt_range[robot.joints[robot.actuated]])
    table = []
    for block in BLOCKS:
        length = len(ids[block.over]) * len(block.components)
        reference = references.get(block.key.removesuffix("_add"), np.zeros(length)).ravel()
        change = block.range * (np.ones(length) if block.adds else reference)
        values = np.stack([reference - change, reference + change])
        if block.key == "nominal":
            values = np.clip(values, limits[:, 0], limits[:, 1])
        elif block.key.endswith("_add"):
            values = np.maximum(values, 0)
        names = [
            (_name(model, block.over, index) if index is not None else "global", component)
            for index in ids[block.over]
            for component in block.components
        ]
        for (part, component), (low, high) in zip(names, values.T, strict=True):
            part = trunk if block.key == "imu" else part
            words = (part_label(part) if part != "global" else "", block.title, component)
            name = " ".join(word for word in words if word)
            table.append(
                Parameter(
                    index=len(table),
                    name=name[0].upper() + name[1:],
                    kind=block.kind,
                    part=part,
                    component=component,
                    low=float(low),
                    high=float(high),
                    unit=block.unit,
                )
            )
    return table
