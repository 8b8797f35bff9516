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

from shapebody.checks import require_integer, require_kind
from shapebody.design import Embodiment, quaternion_product
from shapebody.parameters import soft_limits
from shapebody.robots import Robot, require_robot

JOINT_DESCRIPTION = 30
FOOT_DESCRIPTION = 21
FOOT_SIZE_SCALE = 0.15  # m
MOST_PARTS = 10_000
"""Joints, feet or spheres of a robot."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Frames:
    """World frames of a robot at one configuration, float32, metres; rotations map local to world.

    Joint arrays hold the hinge joints only (all but the free joint), in id order.
    """

    body_pos: jax.Array  # [nbody, 3]
    body_rot: jax.Array  # [nbody, 3, 3]
    geom_pos: jax.Array  # [ngeom, 3]
    geom_rot: jax.Array  # [ngeom, 3, 3]
    site_pos: jax.Array  # [nsite, 3]
    site_rot: jax.Array  # [nsite, 3, 3]
    joint_anchor: jax.Array  # [nj, 3]
    joint_axis: jax.Array  # [nj, 3]
    com: jax.Array  # [nbody, 3] centres of mass


@dataclass(frozen=True)
class Sizes:
    """Numbers of joints, feet and collision spheres to which descriptions are padded."""

    joints: int
    feet: int
    spheres: int

    def __post_init__(self):
        for name, least in (("joints", 1), ("feet", 1), ("spheres", 0)):
            require_integer(name, getattr(self, name), least, MOST_PARTS)

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


# Inside this module vectors are [3, n], quaternions [4, n] and rotations [3, 3, n]. With components
# first, everything is a sum of products of rows, several times faster in XLA than small matrices.


def _matrix(q):
    """Rotations [3, 3, n] of unit quaternions [4, n]."""
    w, x, y, z = q
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row) for row in rows])


def _rotate(rotation, vector):
    """Rotated vectors [3, n] = rotation [3, 3, n] · vector [3, n]."""
    return rotation[:, 0] * vector[0] + rotation[:, 1] * vector[1] + rotation[:, 2] * vector[2]


def _compose(first, second):
    """Rotation products [3, 3, n]."""
    return jnp.stack([_rotate(first, second[:, column]) for column in range(3)], axis=1)


def _take(rows, index):
    """Columns `index` (constant) of rows [..., n]."""
    index = np.asarray(index)
    return rows if np.array_equal(index, np.arange(rows.shape[-1])) else rows[..., index]


def _plan(robot: Robot):
    """The tree below the trunk as L levels of at most W nodes: (body, joint, parent, places...).

    A node is one joint of a body, or a body without joint. `body`, `joint` and `parent` are int
    [L, W]: whose offset it has, which joint turns it, and its parent within the level above. The
    world (body 0, no offset) and the free joint (joint 0, never turned) stand for "none" and for
    padding. The places are the flat indices of the nodes that hold the frames of the bodies from
    2 on and of the hinge joints.
    """
    model = robot.model
    nodes, levels, of_body, of_joint = {1: (0, 0)}, [], {}, {}
    for body in range(2, model.nbody):
        first, number = model.body_jntadr[body], model.body_jntnum[body]
        joints = list(range(first, first + number)) or [0]
        depth, place = nodes[model.body_parentid[body]]
        for joint in joints:
            while len(levels) <= depth:
                levels.append([])
            offset = body if joint == joints[0] else 0
            levels[depth].append((offset, joint, place))
            depth, place = depth + 1, len(levels[depth]) - 1
            of_joint[joint] = (depth - 1, place)
        nodes[body] = (depth, place)
        of_body[body] = (depth - 1, place)
    width = max(len(level) for level in levels)
    table = np.zeros((3, len(levels), width), int)
    for depth, level in enumerate(levels):
        table[:, depth, : len(level)] = np.array(level).T

    def flat(places):
        return np.array([depth * width + place for depth, place in places], int)

    bodies = flat(of_body[body] for body in range(2, model.nbody))
    return *table, bodies, flat(of_joint[joint] for joint in range(1, model.njnt))


def _tree(robot: Robot):
    """Forward kinematics of the bodies of one design, as a scan over the levels of the tree.

    Returns a function (embodiment, qpos) -> body positions [3, nbody], body rotations
    [3, 3, nbody], joint anchors [3, nj], joint axes [3, nj].
    """
    model = robot.model
    body, joint, parent, of_body, of_joint = _plan(robot)
    body, joint = body.ravel(), joint.ravel()
    address = model.jnt_qposadr[joint]
    turned = (0.5 * (joint > 0)).astype(np.float32)
    qpos0 = np.asarray(model.qpos0, np.float32)[address]

    def step(above, level):
        quat, pos = above
        parent, local_quat, local_pos = level
        quat, pos = quat[:, parent], pos[:, parent]
        pos = pos + _rotate(_matrix(quat), local_pos)
        quat = quaternion_product(quat, local_quat)
        return (quat, pos), (quat, pos)

    def forward(e: Embodiment, qpos):
        # All nodes at once: their frames in the frame of their parent.
        offset, offset_quat = e.body_pos[body].T, e.body_quat[body].T
        center, axis = e.jnt_pos[joint].T, e.jnt_axis[joint].T
        half = turned * (qpos[address] - qpos0)
        local_quat = quaternion_product(
            offset_quat, jnp.concatenate([jnp.cos(half)[None], jnp.sin(half) * axis])
        )
        local_pos = offset + _rotate(_matrix(offset_quat), center)
        local_pos = local_pos - _rotate(_matrix(local_quat), center)

        def by_level(rows):
            return jnp.moveaxis(rows.reshape(-1, *parent.shape), 0, 1)

        def flat(rows):
            return jnp.moveaxis(rows, 0, 1).reshape(rows.shape[1], -1)

        root_quat, root_pos = qpos[3:7, None], qpos[:3, None]
        root_quat = root_quat / jnp.sqrt(jnp.sum(root_quat**2))
        start = tuple(jnp.repeat(x, parent.shape[1], axis=1) for x in (root_quat, root_pos))
        levels = parent, by_level(local_quat), by_level(local_pos)
        _, (quat, pos) = jax.lax.scan(step, start, levels)

        # All nodes at once again: their frames in the world.
        quat, pos = flat(quat), flat(pos)
        rot = _matrix(quat)
        anchor = pos + _rotate(rot, center)
        world = np.array([[1.0], [0], [0], [0]], np.float32)
        quat = jnp.concatenate([world, root_quat, quat[:, of_body]], axis=-1)
        pos = jnp.concatenate([world[1:], root_pos, pos[:, of_body]], axis=-1)
        return pos, _matrix(quat), anchor[:, of_joint], _rotate(rot, axis)[:, of_joint]

    return forward


def kinematics(robot: Robot) -> Callable[[Embodiment, jax.Array], Frames]:
    """Forward kinematics of one design: a function (embodiment, qpos [nq]) -> `Frames`.

    Agrees with MuJoCo's `mj_kinematics` (which also normalizes the free joint's quaternion).
    """
    model = require_robot(robot).model
    tree = _tree(robot)
    geom_rot = _constant_rotations(model.geom_quat)
    site_rot = _constant_rotations(model.site_quat)

    def frames(embodiment: Embodiment, qpos) -> Frames:
        e = embodiment
        pos, rot, anchor, axis = tree(e, qpos)
        geom_body = _take(rot, model.geom_bodyid)
        site_body = _take(rot, model.site_bodyid)
        return Frames(
            body_pos=pos.T,
            body_rot=jnp.moveaxis(rot, -1, 0),
            geom_pos=(_take(pos, model.geom_bodyid) + _rotate(geom_body, e.geom_pos.T)).T,
            geom_rot=jnp.moveaxis(_compose(geom_body, geom_rot), -1, 0),
            site_pos=(_take(pos, model.site_bodyid) + _rotate(site_body, e.site_pos.T)).T,
            site_rot=jnp.moveaxis(_compose(site_body, site_rot), -1, 0),
            joint_anchor=anchor.T,
            joint_axis=axis.T,
            com=(pos + _rotate(rot, e.body_ipos.T)).T,
        )

    return frames


def _constant_rotations(quaternions):
    """Rotations [3, 3, n] of constant quaternions [n, 4], as NumPy."""
    rotations = np.zeros((len(quaternions), 9))
    for rotation, quaternion in zip(rotations, quaternions, strict=True):
        mujoco.mju_quat2Mat(rotation, quaternion)
    return np.ascontiguousarray(np.moveaxis(rotations.reshape(-1, 3, 3), 0, -1), np.float32)


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
