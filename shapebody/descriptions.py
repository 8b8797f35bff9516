"""Static descriptions of an embodiment: what the networks are told about joints, feet and body.

Pure JAX: forward kinematics of one design at its nominal pose, then the normalized description
vectors of Appendix A. Nothing here needs a physics engine, and everything is differentiable.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from .design import Embodiment, quaternion_product, soft_limits
from .robots import Robot

JOINT_DESCRIPTION = 30
FOOT_DESCRIPTION = 21
STATIC_DESCRIPTION = 14
FOOT_SIZE_SCALE = 0.15  # m


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

    @staticmethod
    def of(*robots: Robot) -> Sizes:
        """The smallest sizes that fit all `robots`."""
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


def rotation_matrix(quaternion):
    """Rotation matrices [..., 3, 3] of unit quaternions [..., 4], scalar part first."""
    w, x, y, z = (quaternion[..., k] for k in range(4))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def rotate(rotation, vector):
    """Rotated vectors [..., 3] = rotation [..., 3, 3] · vector [..., 3]."""
    return jnp.sum(rotation * vector[..., None, :], axis=-1)


def compose(first, second):
    """Matrix products [..., 3, 3], written as sums: much faster than a batched dot on a CPU."""
    return jnp.sum(first[..., :, :, None] * second[..., None, :, :], axis=-2)


def _levels(robot: Robot) -> list[np.ndarray]:
    """Body ids by depth in the tree: [world], [trunk], ..."""
    parents = robot.model.body_parentid
    depth = np.zeros(len(parents), int)
    for body in range(1, len(parents)):
        depth[body] = depth[parents[body]] + 1
    return [np.flatnonzero(depth == level) for level in range(depth.max() + 1)]


def kinematics(robot: Robot) -> Callable[[Embodiment, jax.Array], Frames]:
    """Forward kinematics of one design: a function (embodiment, qpos [nq]) -> `Frames`.

    Agrees with MuJoCo's `mj_kinematics`. One step per level of the tree, so compile time and run
    time depend on the depth of the robot and not on its number of bodies.
    """
    model = robot.model
    levels = _levels(robot)
    order = np.concatenate(levels)
    place = np.argsort(order)
    hinges = [
        [j for j in range(adr, adr + num) if j > 0] if num else []
        for adr, num in zip(model.body_jntadr, model.body_jntnum, strict=True)
    ]
    joint_order = np.array(
        [
            hinges[body][slot]
            for level in levels
            for slot in range(max(len(hinges[body]) for body in level))
            for body in level
            if len(hinges[body]) > slot
        ],
        int,
    )
    joint_place = np.argsort(joint_order)
    geom_rot = rotation_matrix(jnp.asarray(model.geom_quat, jnp.float32))
    site_rot = rotation_matrix(jnp.asarray(model.site_quat, jnp.float32))
    geom_rot, site_rot = np.asarray(geom_rot), np.asarray(site_rot)
    qpos0 = np.asarray(model.qpos0, np.float32)

    def frames(embodiment: Embodiment, qpos) -> Frames:
        e = embodiment
        quat = jnp.concatenate([e.body_quat[:1], qpos[None, 3:7]])
        quat = quat / jnp.sqrt(jnp.sum(quat**2, axis=-1, keepdims=True))
        pos = jnp.concatenate([e.body_pos[:1], qpos[None, 0:3]])
        rot = rotation_matrix(quat)
        all_pos, all_rot, anchors, axes = [pos], [rot], [], []
        quat, pos, rot = quat[1:], pos[1:], rot[1:]
        for above, level in zip(levels[1:-1], levels[2:], strict=True):
            parent = np.searchsorted(above, model.body_parentid[level])
            if not np.array_equal(parent, np.arange(len(above))):
                quat, pos, rot = quat[parent], pos[parent], rot[parent]
            pos = pos + rotate(rot, e.body_pos[level])
            quat = quaternion_product(quat, e.body_quat[level])
            slots = max(len(hinges[body]) for body in level)
            for slot in range(slots):
                # Bodies without this joint turn by zero about the free joint's (unused) axis.
                joint = np.array([(hinges[b] + [0] * slots)[slot] for b in level])
                address = model.jnt_qposadr[joint]
                half = 0.5 * (qpos[address] - qpos0[address]) * (joint > 0).astype(np.float32)
                axis = e.jnt_axis[joint]
                turn = jnp.concatenate(
                    [jnp.cos(half)[:, None], jnp.sin(half)[:, None] * axis], axis=-1
                )
                anchor = pos + rotate(rotation_matrix(quat), e.jnt_pos[joint])
                quat = quaternion_product(quat, turn)
                rot = rotation_matrix(quat)
                pos = anchor - rotate(rot, e.jnt_pos[joint])
                real = np.flatnonzero(joint > 0)
                anchors.append(anchor[real])
                axes.append(rotate(rot, axis)[real])
            if slots == 0:
                rot = rotation_matrix(quat)
            all_pos.append(pos)
            all_rot.append(rot)
        body_pos = jnp.concatenate(all_pos)[place]
        body_rot = jnp.concatenate(all_rot)[place]
        geom, site = model.geom_bodyid, model.site_bodyid
        return Frames(
            body_pos=body_pos,
            body_rot=body_rot,
            geom_pos=body_pos[geom] + rotate(body_rot[geom], e.geom_pos),
            geom_rot=compose(body_rot[geom], geom_rot),
            site_pos=body_pos[site] + rotate(body_rot[site], e.site_pos),
            site_rot=compose(body_rot[site], site_rot),
            joint_anchor=jnp.concatenate(anchors)[joint_place],
            joint_axis=jnp.concatenate(axes)[joint_place],
            com=body_pos + rotate(body_rot, e.body_ipos),
        )

    return frames


def symmetric_feet(robot: Robot) -> np.ndarray:
    """Pairs of feet that mirror each other across the x-z plane, as float32 [nf, nf], i < j.

    Two feet form a pair if each is the other's nearest in (x, |y|, z), in the reference home pose.
    """
    model, data = robot.model, mujoco.MjData(robot.model)
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
    sizes = own if sizes is None else sizes
    for name in ("joints", "feet", "spheres"):
        if getattr(sizes, name) < getattr(own, name):
            raise ValueError(
                f"sizes.{name} is {getattr(sizes, name)}, expected at least "
                f"{getattr(own, name)} for robot {robot.name!r}; use Sizes.of with all robots"
            )
    model = robot.model
    forward = kinematics(robot)
    joints = robot.joints[robot.actuated]
    dofs = robot.qvel_index
    bodies = model.jnt_bodyid[joints]
    described = np.concatenate([bodies, robot.foot_bodies, [robot.trunk]])
    children = np.bincount(model.body_parentid[1:], minlength=model.nbody)[bodies]
    boxed = np.concatenate([robot.spheres, robot.feet])
    home = np.asarray(robot.home, np.float32)
    home_rot = np.asarray(rotation_matrix(jnp.asarray(home[3:7] / np.linalg.norm(home[3:7]))))
    origin = home.copy()
    origin[:7] = 0, 0, 0, 1, 0, 0, 0
    # One-hot rows put nominal positions into qpos without a scatter.
    place = np.zeros((robot.num_actuators, model.nq), np.float32)
    place[np.arange(robot.num_actuators), robot.qpos_index] = 1
    passive = origin * (1 - place.sum(axis=0))
    num_joints, num_feet = robot.num_actuators, robot.num_feet
    above_diagonal = np.triu(np.ones((robot.num_spheres,) * 2, bool), k=1)

    def padded(values, length, axes=1):
        values = jnp.asarray(values, jnp.float32)
        pad = [(0, length - values.shape[axis]) for axis in range(axes)]
        return jnp.pad(values, pad + [(0, 0)] * (values.ndim - axes))

    joint_mask = np.asarray(padded(np.ones(num_joints), sizes.joints))
    foot_mask = np.asarray(padded(np.ones(num_feet), sizes.feet))
    sphere_mask = np.asarray(padded(np.ones(robot.num_spheres), sizes.spheres))
    keep_nominal = np.asarray(padded(robot.keep_nominal, sizes.joints))
    foot_is_box = np.asarray(padded(robot.foot_types, sizes.feet))
    foot_pairs = np.asarray(padded(symmetric_feet(robot), sizes.feet, axes=2))
    foot_type = 2 * robot.foot_types[:, None] - 1.0

    def single(embodiment: Embodiment) -> Descriptions:
        e = embodiment
        # With the trunk at the origin, world coordinates are trunk coordinates.
        qpos = passive + jnp.sum(place * e.nominal[:, None], axis=0)
        at = forward(e, qpos)

        # A geom reaches as far as its rotated size triple, of which a sphere has only one entry.
        # This is not its true extent, but what descriptions are made of.
        centers = at.geom_pos[boxed]
        reach = jnp.abs(rotate(at.geom_rot[boxed], e.geom_size[boxed]))
        points = jnp.concatenate([at.joint_anchor[robot.actuated], at.com[1:]])
        low = jnp.minimum(jnp.min(centers - reach, axis=0), jnp.min(points, axis=0))
        high = jnp.maximum(jnp.max(centers + reach, axis=0), jnp.max(points, axis=0))
        dimensions = high - low

        def relative(point):
            return 2 * (point - low) / dimensions - 1

        # Principal moments are rotated like a vector, not like a tensor.
        inertia_rot = compose(at.body_rot[described], rotation_matrix(e.body_iquat[described]))
        attributes = jnp.concatenate(
            [
                e.body_mass[described][:, None] / 200 - 1,
                relative(at.com[described]),
                rotate(inertia_rot, e.body_inertia[described]) / 13 - 1,
            ],
            axis=-1,
        )
        joint_bodies = attributes[:num_joints]
        foot_bodies = attributes[num_joints : num_joints + num_feet]
        trunk = attributes[-1]

        total_mass = jnp.sum(e.body_mass[1:])
        gains = jnp.stack([e.p_gain / 85 - 1, e.d_gain / 1 - 1, e.action_scale / 0.75 - 1])
        whole = jnp.concatenate([gains, (total_mass / 450 - 1)[None], dimensions / 1.5 - 1])

        columns = jnp.stack(
            [
                children / np.float32(2.5) - 1,
                e.nominal / 6.5,
                e.actuator_forcerange[:, 1] / 800 - 1,
                e.velocity_limits / 90 - 1,
                e.dof_damping[dofs] / 0.1 - 1,
                e.dof_armature[dofs] / 1.35 - 1,
                e.jnt_stiffness[joints] / 0.1 - 1,
                e.dof_frictionloss[dofs] / 18.5 - 1,
            ],
            axis=-1,
        )
        joint_range = e.jnt_range[joints]
        joint_rows = jnp.concatenate(
            [
                relative(at.joint_anchor[robot.actuated]),
                at.joint_axis[robot.actuated],
                joint_bodies,
                columns,
                joint_range / 6.5,
                jnp.broadcast_to(whole, (num_joints, 7)),
            ],
            axis=-1,
        )
        feet = at.geom_pos[robot.feet]
        foot_size = e.geom_size[robot.feet]
        foot_rows = jnp.concatenate(
            [
                relative(feet),
                foot_bodies,
                foot_size / FOOT_SIZE_SCALE - 1,
                jnp.asarray(foot_type, jnp.float32),
                jnp.broadcast_to(whole, (num_feet, 7)),
            ],
            axis=-1,
        )

        home_height = -jnp.min(jnp.sum(feet * home_rot[2], axis=-1))
        imu = at.site_pos[robot.imu_site]
        radius = e.geom_size[robot.spheres, 0]
        spheres = at.geom_pos[robot.spheres]
        distance2 = jnp.sum((spheres[:, None] - spheres[None]) ** 2, axis=-1)
        touching = distance2 < (radius[:, None] + radius[None]) ** 2
        collisions = jnp.sum(jnp.where(above_diagonal, touching, False).astype(jnp.float32))

        return Descriptions(
            joints=padded(joint_rows, sizes.joints),
            joint_mask=jnp.asarray(joint_mask),
            feet=padded(foot_rows, sizes.feet),
            foot_mask=jnp.asarray(foot_mask),
            static=jnp.concatenate([whole, trunk]),
            nominal=padded(e.nominal, sizes.joints),
            action_scale=e.action_scale,
            velocity_limits=padded(e.velocity_limits, sizes.joints),
            soft_limits=padded(soft_limits(joint_range), sizes.joints),
            keep_nominal=jnp.asarray(keep_nominal),
            foot_size=padded(foot_size, sizes.feet),
            foot_is_box=jnp.asarray(foot_is_box),
            foot_pairs=jnp.asarray(foot_pairs),
            sphere_radius=padded(radius, sizes.spheres),
            sphere_mask=jnp.asarray(sphere_mask),
            home_height=home_height,
            imu_height=home_height + jnp.sum(imu * home_rot[2]),
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
