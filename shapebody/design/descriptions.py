"""Static descriptions of an embodiment: what the networks are told about joints, feet and body.

Pure JAX: forward kinematics of one design at its nominal pose, then the description vectors of
Appendix A, brought to the order of 1 by `NORMALIZERS`. All that depends on the design is
differentiable and needs no physics engine; MuJoCo's kinematics are asked once per robot, for which
foot mirrors which.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from shapebody.arguments import require_flag, require_kind
from shapebody.configuration import configuration, integer
from shapebody.design.kinematics import take_columns
from shapebody.design.mirror import ROTATION, Mirrored, mirror_signs, reversed_joints
from shapebody.design.nominal_pose import Pose, nominal_pose
from shapebody.design.parameters import soft_limits
from shapebody.design.phi import Embodiment
from shapebody.robot.robot import Robot, require_robot
from shapebody.rotations import constant_matrices, rotate, rotation_matrices

MOST_PARTS = 10_000
"""Joints, feet or spheres of a robot."""


class Normalizer(NamedTuple):
    """How a quantity becomes an entry of a description: value / scale - offset.

    With an offset of 1, values from 0 to 2 x scale become -1 to 1; nothing is clipped.
    """

    scale: float
    offset: float
    unit: str
    what: str

    def __call__(self, value):
        normalized = value / self.scale
        return normalized - self.offset if self.offset else normalized


NORMALIZERS = {
    "mass": Normalizer(200.0, 1.0, "kg", "mass of one body"),
    "inertia": Normalizer(13.0, 1.0, "kg m²", "principal inertias of one body, turned as a vector"),
    "children": Normalizer(2.5, 1.0, "", "number of bodies that hang at the joint's body"),
    "nominal": Normalizer(6.5, 0.0, "rad", "nominal joint position"),
    "torque": Normalizer(800.0, 1.0, "N m", "torque limit"),
    "velocity": Normalizer(90.0, 1.0, "rad/s", "velocity limit"),
    "damping": Normalizer(0.1, 1.0, "N m s/rad", "damping of a joint"),
    "armature": Normalizer(1.35, 1.0, "kg m²", "inertia of a motor, seen from its joint"),
    "stiffness": Normalizer(0.1, 1.0, "N m/rad", "stiffness of a joint"),
    "friction": Normalizer(18.5, 1.0, "N m", "dry friction of a joint"),
    "range": Normalizer(6.5, 0.0, "rad", "lower and upper end of a joint's range"),
    "p_gain": Normalizer(85.0, 1.0, "N m/rad", "P gain of all motors"),
    "d_gain": Normalizer(1.0, 1.0, "N m s/rad", "D gain of all motors"),
    "action_scale": Normalizer(0.75, 1.0, "rad", "change of the target by an action of 1"),
    "total_mass": Normalizer(450.0, 1.0, "kg", "mass of the robot"),
    "dimensions": Normalizer(1.5, 1.0, "m", "length, width and height of the bounding box"),
    "foot_size": Normalizer(0.15, 1.0, "m", "size of a foot's geom, as in MuJoCo"),
    "foot_type": Normalizer(0.5, 1.0, "", "0 for a sphere, 1 for a box"),
}
"""The paper prints no normalization. All but the last two are those of the authors' published
policies, whose descriptions they reproduce to 1e-7; those of feet, which only the unpublished
critics see, are chosen here. Positions are relative to the robot's bounding box instead, and axes
are unit vectors."""


Parts = integer(1, MOST_PARTS)


@configuration
class Sizes:
    """Numbers of joints, feet and collision spheres to which descriptions are padded."""

    joints: Parts
    feet: Parts
    spheres: integer(0, MOST_PARTS)

    @staticmethod
    def of(*robots: Robot) -> Sizes:
        """The smallest sizes that fit all `robots`."""
        if not robots:
            raise ValueError("robots is (); expected at least one Robot")
        for robot in robots:
            require_robot(robot)
        return Sizes(
            joints=max(robot.num_actuators for robot in robots),
            feet=max(robot.num_feet for robot in robots),
            spheres=max(robot.num_spheres for robot in robots),
        )


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Descriptions:
    """Descriptions of one design, float32, padded with zeros to `Sizes` (J, F, S).

    Joints are the actuated ones, in actuator order. Masks are 1 for real entries, 0 for padding.
    The columns of the three vectors that networks see, in order (Appendix A, `NORMALIZERS`):

    - whole robot, 7: P gain, D gain, action scale, total mass, length, width, height
    - a body, 7: mass, centre of mass x y z, principal inertias 3
    - `joints`, 30: position 3, axis 3, the joint's body 7, children, nominal position, torque
      limit, velocity limit, damping, armature, stiffness, friction, range 2, whole robot 7
    - `feet`, 21: position 3, the foot's body 7, size 3, type, whole robot 7
    - `static`, 14: whole robot 7, trunk 7

    Positions are of the nominal pose, from -1 to 1 across the robot's bounding box.
    """

    joints: jax.Array  # [J, 30] normalized joint descriptions d_j
    joint_mask: jax.Array  # [J]
    feet: jax.Array  # [F, 21] normalized foot descriptions d_f
    foot_mask: jax.Array  # [F]
    static: jax.Array  # [14] of the whole robot and its trunk, for the core networks
    nominal: jax.Array  # [J] rad
    action_scale: jax.Array  # [] rad
    velocity_limits: jax.Array  # [J] rad/s
    soft_limits: jax.Array  # [J, 2] rad, of the design's own joint ranges
    keep_nominal: jax.Array  # [J] 1 for joints that always should: arms, head, waist
    foot_size: jax.Array  # [F, 3] m, as in MuJoCo
    foot_is_box: jax.Array  # [F]
    foot_pairs: jax.Array  # [F, F] 1 at (i, j), i < j, for feet that mirror each other
    sphere_radius: jax.Array  # [S] m
    sphere_mask: jax.Array  # [S]
    home_height: jax.Array  # [] m, trunk height at the nominal pose with foot centres at 0
    imu_height: jax.Array  # [] m, IMU height at that pose
    nominal_collisions: jax.Array  # [] number of sphere pairs that overlap at that pose
    dimensions: jax.Array  # [3] m, bounding box at that pose, in the trunk frame
    total_mass: jax.Array  # [] kg
    mirrored: Mirrored | None = None  # of the mirror image of the body, if asked for


def symmetric_feet(robot: Robot) -> np.ndarray:
    """Pairs of feet that mirror each other across the x-z plane, as float32 [nf, nf], i < j.

    Two feet form a pair if each is the other's nearest in (x, |y|, z), in the reference home pose.
    """
    model, data = require_robot(robot).model, mujoco.MjData(robot.model)
    data.qpos[:] = robot.home
    mujoco.mj_kinematics(model, data)
    trunk_rot = data.xmat[robot.trunk].reshape(3, 3)
    points = (data.geom_xpos[robot.feet] - data.xpos[robot.trunk]) @ trunk_rot
    points[:, 1] = np.abs(points[:, 1])
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1)
    np.fill_diagonal(distance, np.inf)
    pairs = np.zeros(distance.shape, np.float32)
    nearest = np.argmin(distance, axis=1)
    for i, j in enumerate(nearest):
        if i < j and nearest[j] == i:
            pairs[i, j] = 1
    return pairs


def describe(
    robot: Robot, sizes: Sizes | None = None, mirror: bool = False
) -> Callable[[Embodiment], Descriptions]:
    """A function embodiment -> `Descriptions`, padded to `sizes` (default: those of the robot).

    With `mirror`, they also hold the descriptions of the mirror image of the body (`mirror`).

    It takes embodiments with any leading axes, and can be jitted, vmapped and differentiated.
    Padding changes no other number.

    Raises:
        ValueError: if `sizes` are smaller than the robot's.
    """
    sizes = _fitting(sizes, robot)
    require_flag("mirror", mirror)
    at_nominal = nominal_pose(robot)
    # What does not depend on the design, in NumPy so that it works inside a trace.
    joint_mask = _padded_constant(np.ones(robot.num_actuators), sizes.joints)
    foot_mask = _padded_constant(np.ones(robot.num_feet), sizes.feet)
    sphere_mask = _padded_constant(np.ones(robot.num_spheres), sizes.spheres)
    keep_nominal = _padded_constant(robot.keep_nominal, sizes.joints)
    foot_is_box = _padded_constant(robot.foot_types, sizes.feet)
    foot_pairs = _padded_constant(symmetric_feet(robot), sizes.feet, axes=2)
    home_quat = robot.home[3:7] / np.linalg.norm(robot.home[3:7])
    up = constant_matrices(home_quat[None])[2, :, 0]  # vertical axis in the trunk frame
    sign = _padded_constant(mirror_signs(robot), sizes.joints)

    def single(embodiment: Embodiment) -> Descriptions:
        e = embodiment
        pose = at_nominal(e)
        total_mass = jnp.sum(e.body_mass[1:])
        joint_range = take_columns(e.jnt_range.T, robot.joints[robot.actuated])
        joints, feet, static = vectors(e, pose, total_mass, joint_range)
        image = None
        if mirror:
            their_joints, *others = vectors(e, at_nominal(e, True), total_mass, joint_range, True)
            image = Mirrored(jnp.asarray(sign), reversed_joints(their_joints, sign), *others)
        # Sums instead of products of matrices, which accelerators round to fewer digits.
        home_height = -jnp.min(jnp.sum(up[:, None] * pose.feet, axis=0))
        imu_height = home_height + jnp.sum(up * e.site_pos[robot.imu_site])
        return Descriptions(
            joints=joints,
            joint_mask=jnp.asarray(joint_mask),
            feet=feet,
            foot_mask=jnp.asarray(foot_mask),
            static=static,
            nominal=_padded(e.nominal, sizes.joints),
            action_scale=e.action_scale,
            velocity_limits=_padded(e.velocity_limits, sizes.joints),
            soft_limits=_padded(soft_limits(joint_range.T), sizes.joints),
            keep_nominal=jnp.asarray(keep_nominal),
            foot_size=_padded(pose.foot_size.T, sizes.feet),
            foot_is_box=jnp.asarray(foot_is_box),
            foot_pairs=jnp.asarray(foot_pairs),
            sphere_radius=_padded(pose.sphere_radius, sizes.spheres),
            sphere_mask=jnp.asarray(sphere_mask),
            home_height=home_height,
            imu_height=imu_height,
            nominal_collisions=_overlapping_pairs(pose.spheres, pose.sphere_radius),
            dimensions=pose.dimensions,
            total_mass=total_mass,
            mirrored=image,
        )

    def vectors(e: Embodiment, pose: Pose, total_mass, joint_range, mirror=False):
        """What the networks see: joints [J, 30], feet [F, 21], static [14]."""
        bodies = _body_rows(e, pose, mirror)
        whole = _whole(e, total_mass, pose.dimensions)
        joints = _joint_rows(robot, e, pose, bodies, whole, joint_range)
        feet = _foot_rows(robot, pose, bodies, whole)
        return (
            _padded(joints.T, sizes.joints),
            _padded(feet.T, sizes.feet),
            jnp.concatenate([whole, bodies[:, robot.trunk]]),
        )

    def function(embodiment: Embodiment) -> Descriptions:
        mapped = single
        for _ in range(embodiment.p_gain.ndim):
            mapped = jax.vmap(mapped)
        return mapped(embodiment)

    return function


def _fitting(sizes: Sizes | None, robot: Robot) -> Sizes:
    """`sizes`, by default the robot's own; ValueError if the robot does not fit into them."""
    own = Sizes.of(robot)
    sizes = own if sizes is None else require_kind("sizes", sizes, Sizes, "Sizes.of(*robots)")
    for name in ("joints", "feet", "spheres"):
        if getattr(sizes, name) < getattr(own, name):
            raise ValueError(
                f"sizes.{name} is {getattr(sizes, name)}, expected at least "
                f"{getattr(own, name)} for robot {robot.name!r}; use Sizes.of with all robots"
            )
    return sizes


# ------------------------------------------------------------------ the vectors of Appendix A


def _body_rows(e: Embodiment, pose: Pose, mirror: bool):
    """Mass, centre of mass and inertia of every body: [7, nbody]; `pose` may be a mirrored one."""
    n = NORMALIZERS
    # Principal moments are rotated like a vector, not like a tensor.
    frames = rotation_matrices(e.body_iquat.T)
    frames = ROTATION * frames if mirror else frames
    moments = n["inertia"](rotate(pose.rot, rotate(frames, e.body_inertia.T)))
    return jnp.concatenate([n["mass"](e.body_mass[None]), pose.relative(pose.com), moments])


def _whole(e: Embodiment, total_mass, dimensions):
    """What all joints and feet are told about the whole robot: gains, mass, dimensions, [7]."""
    n = NORMALIZERS
    gains = [n["p_gain"](e.p_gain), n["d_gain"](e.d_gain), n["action_scale"](e.action_scale)]
    mass = n["total_mass"](total_mass)[None]
    return jnp.concatenate([jnp.stack(gains), mass, n["dimensions"](dimensions)])


def _joint_rows(robot: Robot, e: Embodiment, pose: Pose, bodies, whole, joint_range):
    """Descriptions of the actuated joints, [30, J]."""
    n, model = NORMALIZERS, robot.model
    joints, dofs = robot.joints[robot.actuated], robot.qvel_index
    own = model.jnt_bodyid[joints]
    children = np.bincount(model.body_parentid[1:], minlength=model.nbody)[own]
    return jnp.concatenate(
        [
            pose.relative(pose.anchor),
            pose.axis,
            take_columns(bodies, own),
            n["children"](children[None]).astype(np.float32),
            n["nominal"](e.nominal[None]),
            n["torque"](e.actuator_forcerange[None, :, 1]),
            n["velocity"](e.velocity_limits[None]),
            n["damping"](take_columns(e.dof_damping, dofs)[None]),
            n["armature"](take_columns(e.dof_armature, dofs)[None]),
            n["stiffness"](take_columns(e.jnt_stiffness, joints)[None]),
            n["friction"](take_columns(e.dof_frictionloss, dofs)[None]),
            n["range"](joint_range),
            jnp.broadcast_to(whole[:, None], (len(whole), len(joints))),
        ]
    )


def _foot_rows(robot: Robot, pose: Pose, bodies, whole):
    """Descriptions of the feet, [21, F]."""
    n = NORMALIZERS
    return jnp.concatenate(
        [
            pose.relative(pose.feet),
            take_columns(bodies, robot.foot_bodies),
            n["foot_size"](pose.foot_size),
            n["foot_type"](robot.foot_types[None]).astype(np.float32),
            jnp.broadcast_to(whole[:, None], (len(whole), robot.num_feet)),
        ]
    )


def _overlapping_pairs(centers, radius):
    """Number of pairs that overlap, float32 [], of spheres with centres [3, S] and radii [S]."""
    above_diagonal = np.triu(np.ones((radius.shape[0],) * 2, bool), k=1)
    distance2 = sum((row[:, None] - row[None]) ** 2 for row in centers)
    touching = distance2 <= (radius[:, None] + radius[None]) ** 2
    return jnp.sum(jnp.where(above_diagonal, touching, False).astype(jnp.float32))


# ------------------------------------------------------------------ padding


def _padded(values, length: int):
    """float32 with zeros added to the first axis."""
    values = jnp.asarray(values, jnp.float32)
    return jnp.pad(values, [(0, length - values.shape[0])] + [(0, 0)] * (values.ndim - 1))


def _padded_constant(values, length: int, axes: int = 1) -> np.ndarray:
    """float32 with zeros added to the first `axes` axes."""
    values = np.asarray(values, np.float32)
    pad = [(0, length - n) for n in values.shape[:axes]]
    return np.pad(values, pad + [(0, 0)] * (values.ndim - axes))
