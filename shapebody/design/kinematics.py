"""Forward kinematics of an embodiment in JAX: frames of bodies, geoms and sites."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from shapebody.design.phi import Embodiment
from shapebody.robot.robot import Robot, require_robot
from shapebody.rotations import (
    compose,
    constant_matrices,
    quaternion_product,
    rotate,
    rotation_matrices,
)


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


def take_columns(rows, index):
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


def body_kinematics(robot: Robot):
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
        pos = pos + rotate(rotation_matrices(quat), local_pos)
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
        local_pos = offset + rotate(rotation_matrices(offset_quat), center)
        local_pos = local_pos - rotate(rotation_matrices(local_quat), center)

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
        rot = rotation_matrices(quat)
        anchor = pos + rotate(rot, center)
        world = np.array([[1.0], [0], [0], [0]], np.float32)
        quat = jnp.concatenate([world, root_quat, quat[:, of_body]], axis=-1)
        pos = jnp.concatenate([world[1:], root_pos, pos[:, of_body]], axis=-1)
        return pos, rotation_matrices(quat), anchor[:, of_joint], rotate(rot, axis)[:, of_joint]

    return forward


def kinematics(robot: Robot) -> Callable[[Embodiment, jax.Array], Frames]:
    """Forward kinematics of one design: a function (embodiment, qpos [nq]) -> `Frames`.

    Agrees with MuJoCo's `mj_kinematics` (which also normalizes the free joint's quaternion).
    """
    model = require_robot(robot).model
    tree = body_kinematics(robot)
    geom_rot = constant_matrices(model.geom_quat)
    site_rot = constant_matrices(model.site_quat)

    def frames(embodiment: Embodiment, qpos) -> Frames:
        e = embodiment
        pos, rot, anchor, axis = tree(e, qpos)
        geom_body = take_columns(rot, model.geom_bodyid)
        site_body = take_columns(rot, model.site_bodyid)
        return Frames(
            body_pos=pos.T,
            body_rot=jnp.moveaxis(rot, -1, 0),
            geom_pos=(take_columns(pos, model.geom_bodyid) + rotate(geom_body, e.geom_pos.T)).T,
            geom_rot=jnp.moveaxis(compose(geom_body, geom_rot), -1, 0),
            site_pos=(take_columns(pos, model.site_bodyid) + rotate(site_body, e.site_pos.T)).T,
            site_rot=jnp.moveaxis(compose(site_body, site_rot), -1, 0),
            joint_anchor=anchor.T,
            joint_axis=axis.T,
            com=(pos + rotate(rot, e.body_ipos.T)).T,
        )

    return frames
