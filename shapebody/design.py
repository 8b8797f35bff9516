"""The design space: the map Φ from a normalized vector f in [-1, 1]^d to an embodiment.

One number per continuous property of a robot, in 26 blocks (`BLOCKS`) of fixed order. f = 0 is the
reference robot. Φ is smooth in f (up to clipping), so that ∂V/∂f can follow ∂V/∂Φ(f).
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from shapebody.checks import (
    require_array,
    require_integer,
    require_kind,
    require_list,
    require_seed,
    require_text,
    single,
)
from shapebody.mjcf import build_model, write_mjcf
from shapebody.parameters import (
    BLOCKS,
    KINDS,
    Parameter,
    parameter_table,
    part_label,
    part_name,
    soft_limits,
)
from shapebody.robots import Robot, require_robot


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


MOST_STARTS = 2**63
"""Numbers of start designs are below this."""
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


def quaternion_product(p, q):
    """Products p ⊗ q of quaternions [4, n], scalar part first."""
    return jnp.stack(
        [
            p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
            p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
            p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
            p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
        ]
    )


def _turned(quaternions, axis, angle):
    """Quaternions [n, 4] after rotations by `angle` [n] about unit vectors `axis` [n, 3]."""
    half = 0.5 * angle
    turn = jnp.concatenate([jnp.cos(half)[None], jnp.sin(half) * axis.T])
    return quaternion_product(turn, quaternions.T).T


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
        self.robot = require_robot(robot)
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
            generator = np.random.default_rng(require_seed("axes_seed", axes_seed))
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
        require_integer("the number of a start design", seed, 0, MOST_STARTS)
        return np.random.default_rng(seed).uniform(-1, 1, self.dim).astype(np.float32)

    def validate(self, f) -> np.ndarray:
        """Return f as float32 [..., d]; ValueError if its length, finiteness or box is wrong."""
        f = self._float32(f, np)
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

    def _float32(self, f, numpy):
        """Designs [..., d] as float32, an array of `numpy` (or jax.numpy: also a traced one)."""
        if not isinstance(f, jax.Array):
            try:
                f = require_array("design", f, finite=False)
            except ValueError as error:
                raise ValueError(
                    f"{error}, {self.dim} of them; use a design of robot {self.robot.name!r}, such "
                    "as space.start(0)"
                ) from None
            f = single(f)
        f = numpy.asarray(f, numpy.float32)
        if f.ndim == 0 or f.shape[-1] != self.dim:
            raise ValueError(
                f"design has shape {f.shape}, expected [..., {self.dim}] for robot "
                f"{self.robot.name!r}; use a design of this robot, such as space.start(0)"
            )
        return f

    def __call__(self, f) -> Embodiment:
        """Φ(f): embodiment of designs f [..., d]."""
        f = self._float32(f, jnp)
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
        return parameter_table(self.robot)

    @functools.cached_property
    def groups(self) -> dict[str, np.ndarray]:
        """Indices into f by label: first every parameter type of `KINDS`, then every body part.

        Types partition f, and so do parts (`parts`): bodies, joints, actuators and feet under their
        `part_label` in alphabetical order, then "Trunk" and "Global". The paper's figure
        (Section 4.3) has separate columns for a joint and a body of the same label (two for "FL
        calf" of the Go2, 30 in all); here they share a part (18 in all).
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

    def frozen(self, names) -> np.ndarray:
        """Which entries of f the names stand for, bool [d].

        Args:
            names: keys of `slices` ("size": the three factors of the whole body), labels of
                `groups` ("Torque limit", "Trunk").

        Raises:
            ValueError: for a name that is neither; the known ones are listed.
        """
        chosen = np.zeros(self.dim, bool)
        for name in (names,) if isinstance(names, str) else require_list("names", names):
            require_text("a name of parameters", name)
            known = self.slices if name in self.slices else self.groups
            if name not in known:
                raise ValueError(
                    f"there are no parameters {name!r} of robot {self.robot.name!r} to be frozen; "
                    f"known: {', '.join([*self.slices, *self.groups])}"
                )
            chosen[known[name]] = True
        return chosen

    def _order_parts(self, labels):
        trunk = part_label(part_name(self.robot.model, "body", self.robot.trunk))
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
