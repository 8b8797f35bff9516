"""Static descriptions of an embodiment: what the networks are told about joints, feet and body.

Pure JAX: forward kinematics of one design at its nominal pose, then the normalized description
vectors of Appendix A. All that depends on the design is differentiable and needs no physics engine;
MuJoCo's kinematics are asked once per robot, for which foot mirrors which.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from shapebody.arguments import require_kind
from shapebody.configuration import configuration, integer
from shapebody.design.kinematics import _constant_rotations, _matrix, _rotate, _take, _tree
from shapebody.design.parameters import soft_limits
from shapebody.design.phi import Embodiment
from shapebody.robot.robot import Robot, require_robot

JOINT_DESCRIPTION = 30

FOOT_DESCRIPTION = 21

FOOT_SIZE_SCALE = 0.15  # m

MOST_PARTS = 10_000
"""Joints, feet or spheres of a robot."""


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
    """

    joints: jax.Array  # [J, 30] normalized joint descriptions d_j
    joint_mask: jax.Array  # [J]
    feet: jax.Array  # [F, 21] normalized foot descriptions d_f
    foot_mask: jax.Array  # [F]
    static: jax.Array  # [14] normalized gains and scale 3, total mass 1, dimensions 3, trunk 7
    nominal: jax.Array  # [J] rad
    action_scale: jax.Array  # [] rad
    velocity_limits: jax.Array  # [J] rad/s
    soft_limits: jax.Array  # [J, 2] rad, of the design's own joint ranges
    keep_nominal: jax.Array  # [J] 1 for arms, head, waist
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


def describe(robot: Robot, sizes: Sizes | None = None) -> Callable[[Embodiment], Descriptions]:
    """A function embodiment -> `Descriptions`, padded to `sizes` (default: those of the robot).

    Can be jitted, vmapped and differentiated. Padding changes no other number.
    Raises ValueError if `sizes` are smaller than the robot's.
    """
    own = Sizes.of(robot)
    sizes = own if sizes is None else require_kind("sizes", sizes, Sizes, "Sizes.of(*robots)")
    for name in ("joints", "feet", "spheres"):
        if getattr(sizes, name) < getattr(own, name):
            raise ValueError(
                f"sizes.{name} is {getattr(sizes, name)}, expected at least "
                f"{getattr(own, name)} for robot {robot.name!r}; use Sizes.of with all robots"
            )
    model = robot.model
    forward = _tree(robot)
    joints = robot.joints[robot.actuated]
    dofs = robot.qvel_index
    bodies = model.jnt_bodyid[joints]
    children = np.bincount(model.body_parentid[1:], minlength=model.nbody)[bodies]
    children = (children[None] / 2.5 - 1).astype(np.float32)
    boxed = np.concatenate([robot.spheres, robot.feet])
    home = np.asarray(robot.home, np.float32)
    home_quat = robot.home[3:7] / np.linalg.norm(robot.home[3:7])
    up = _constant_rotations(home_quat[None])[2, :, 0]  # vertical axis in the trunk frame
    origin = home.copy()
    origin[:7] = 0, 0, 0, 1, 0, 0, 0
    # One-hot rows put nominal positions into qpos without a scatter.
    place = np.zeros((robot.num_actuators, model.nq), np.float32)
    place[np.arange(robot.num_actuators), robot.qpos_index] = 1
    not_actuated = origin * (1 - place.sum(axis=0))
    num_joints, num_feet = robot.num_actuators, robot.num_feet
    above_diagonal = np.triu(np.ones((robot.num_spheres,) * 2, bool), k=1)

    def padded(values, length, axes=1):
        values = jnp.asarray(values, jnp.float32)
        pad = [(0, length - values.shape[axis]) for axis in range(axes)]
        return jnp.pad(values, pad + [(0, 0)] * (values.ndim - axes))

    def constant(values, length, axes=1):
        """`padded` for what does not depend on the design; NumPy, so that it works in a trace."""
        values = np.asarray(values, np.float32)
        pad = [(0, length - n) for n in values.shape[:axes]]
        return np.pad(values, pad + [(0, 0)] * (values.ndim - axes))

    joint_mask = constant(np.ones(num_joints), sizes.joints)
    foot_mask = constant(np.ones(num_feet), sizes.feet)
    sphere_mask = constant(np.ones(robot.num_spheres), sizes.spheres)
    keep_nominal = constant(robot.keep_nominal, sizes.joints)
    foot_is_box = constant(robot.foot_types, sizes.feet)
    foot_pairs = constant(symmetric_feet(robot), sizes.feet, axes=2)
    foot_type = (2 * robot.foot_types[None] - 1).astype(np.float32)
    boxed_rot = _constant_rotations(model.geom_quat[boxed])

    def single(embodiment: Embodiment) -> Descriptions:
        e = embodiment
        # With the trunk at the origin, world coordinates are trunk coordinates.
        qpos = not_actuated + jnp.sum(place * e.nominal[:, None], axis=0)
        pos, rot, anchor, axis = forward(e, qpos)
        com = pos + _rotate(rot, e.body_ipos.T)

        # A geom reaches as far as its rotated size triple, of which a sphere has only one entry.
        # This is not its true extent, but what descriptions are made of.
        box_rot = _take(rot, model.geom_bodyid[boxed])
        center = _take(pos, model.geom_bodyid[boxed]) + _rotate(box_rot, _take(e.geom_pos.T, boxed))
        size = _take(e.geom_size.T, boxed)
        reach = jnp.abs(_rotate(box_rot, _rotate(boxed_rot, size)))
        anchor, axis = _take(anchor, robot.actuated), _take(axis, robot.actuated)
        points = jnp.concatenate([anchor, com[:, 1:]], axis=-1)
        low = jnp.min(jnp.concatenate([center - reach, points], axis=-1), axis=-1, keepdims=True)
        high = jnp.max(jnp.concatenate([center + reach, points], axis=-1), axis=-1, keepdims=True)
        # Without a barrier XLA computes the whole tree again for every number that uses the box.
        low, high = jax.lax.optimization_barrier((low, high))
        dimensions = (high - low)[:, 0]

        def relative(point):
            return 2 * (point - low) / (high - low) - 1

        # Principal moments are rotated like a vector, not like a tensor.
        moments = _rotate(rot, _rotate(_matrix(e.body_iquat.T), e.body_inertia.T)) / 13 - 1
        attributes = jnp.concatenate([e.body_mass[None] / 200 - 1, relative(com), moments])
        trunk = attributes[:, robot.trunk]

        total_mass = jnp.sum(e.body_mass[1:])
        gains = jnp.stack([e.p_gain / 85 - 1, e.d_gain / 1 - 1, e.action_scale / 0.75 - 1])
        whole = jnp.concatenate([gains, (total_mass / 450 - 1)[None], dimensions / 1.5 - 1])

        joint_range = _take(e.jnt_range.T, joints)
        joint_rows = jnp.concatenate(
            [
                relative(anchor),
                axis,
                _take(attributes, bodies),
                children,
                e.nominal[None] / 6.5,
                e.actuator_forcerange[None, :, 1] / 800 - 1,
                e.velocity_limits[None] / 90 - 1,
                _take(e.dof_damping, dofs)[None] / 0.1 - 1,
                _take(e.dof_armature, dofs)[None] / 1.35 - 1,
                _take(e.jnt_stiffness, joints)[None] / 0.1 - 1,
                _take(e.dof_frictionloss, dofs)[None] / 18.5 - 1,
                joint_range / 6.5,
                jnp.broadcast_to(whole[:, None], (7, num_joints)),
            ]
        )
        spheres, feet = center[:, : robot.num_spheres], center[:, robot.num_spheres :]
        foot_size = size[:, robot.num_spheres :]
        foot_rows = jnp.concatenate(
            [
                relative(feet),
                _take(attributes, robot.foot_bodies),
                foot_size / FOOT_SIZE_SCALE - 1,
                foot_type,
                jnp.broadcast_to(whole[:, None], (7, num_feet)),
            ]
        )

        # Sums instead of products of matrices, which accelerators round to fewer digits.
        home_height = -jnp.min(jnp.sum(up[:, None] * feet, axis=0))
        imu_height = home_height + jnp.sum(up * e.site_pos[robot.imu_site])
        radius = size[0, : robot.num_spheres]
        distance2 = sum((row[:, None] - row[None]) ** 2 for row in spheres)
        touching = distance2 <= (radius[:, None] + radius[None]) ** 2
        collisions = jnp.sum(jnp.where(above_diagonal, touching, False).astype(jnp.float32))

        return Descriptions(
            joints=padded(joint_rows.T, sizes.joints),
            joint_mask=jnp.asarray(joint_mask),
            feet=padded(foot_rows.T, sizes.feet),
            foot_mask=jnp.asarray(foot_mask),
            static=jnp.concatenate([whole, trunk]),
            nominal=padded(e.nominal, sizes.joints),
            action_scale=e.action_scale,
            velocity_limits=padded(e.velocity_limits, sizes.joints),
            soft_limits=padded(soft_limits(joint_range.T), sizes.joints),
            keep_nominal=jnp.asarray(keep_nominal),
            foot_size=padded(foot_size.T, sizes.feet),
            foot_is_box=jnp.asarray(foot_is_box),
            foot_pairs=jnp.asarray(foot_pairs),
            sphere_radius=padded(radius, sizes.spheres),
            sphere_mask=jnp.asarray(sphere_mask),
            home_height=home_height,
            imu_height=imu_height,
            nominal_collisions=collisions,
            dimensions=dimensions,
            total_mass=total_mass,
        )

    def function(embodiment: Embodiment) -> Descriptions:
        mapped = single
        for _ in range(embodiment.p_gain.ndim):
            mapped = jax.vmap(mapped)
        return mapped(embodiment)

    return function
