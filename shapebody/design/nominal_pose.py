"""A body at its nominal joint positions: where its parts are, and the box around them.

Forward kinematics in JAX, in the frame of the trunk. Descriptions are made of this.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from shapebody.design.kinematics import body_kinematics, take_columns
from shapebody.design.mirror import ROTATION, VECTOR
from shapebody.design.phi import Embodiment
from shapebody.robot.robot import Robot
from shapebody.rotations import constant_matrices, rotate


class Pose(NamedTuple):
    """A design at its nominal pose, in the trunk frame, metres; one column per part."""

    rot: jax.Array  # [3, 3, nbody] of the bodies
    com: jax.Array  # [3, nbody] their centres of mass
    anchor: jax.Array  # [3, J] of the actuated joints
    axis: jax.Array  # [3, J]
    spheres: jax.Array  # [3, S] centres of the collision spheres
    sphere_radius: jax.Array  # [S]
    feet: jax.Array  # [3, F] centres
    foot_size: jax.Array  # [3, F]
    low: jax.Array  # [3, 1] corners of the bounding box
    high: jax.Array  # [3, 1]
    dimensions: jax.Array  # [3] high - low

    def relative(self, points):
        """Points [3, n] within the bounding box: from -1 at its lower end to 1 at its upper."""
        return 2 * (points - self.low) / (self.high - self.low) - 1


def nominal_pose(robot: Robot) -> Callable[..., Pose]:
    """A function (embodiment, mirror=False) -> `Pose`: forward kinematics of one embodiment at its
    nominal joint positions; with `mirror`, that of its mirror image (`mirror`)."""
    model, forward = robot.model, body_kinematics(robot)
    boxed = np.concatenate([robot.spheres, robot.feet])
    boxed_bodies = model.geom_bodyid[boxed]
    boxed_rot = constant_matrices(model.geom_quat[boxed])
    # With the trunk at the origin, world coordinates are trunk coordinates.
    origin = np.array(robot.home, np.float32)
    origin[:7] = 0, 0, 0, 1, 0, 0, 0
    # One-hot rows put nominal positions into qpos without a scatter.
    place = np.zeros((robot.num_actuators, model.nq), np.float32)
    place[np.arange(robot.num_actuators), robot.qpos_index] = 1
    not_actuated = origin * (1 - place.sum(axis=0))

    def at_nominal(e: Embodiment, mirror: bool = False) -> Pose:
        qpos = not_actuated + jnp.sum(place * e.nominal[:, None], axis=0)
        pos, rot, anchor, axis = forward(e, qpos)
        ipos, geom_pos, geom_rot = e.body_ipos.T, e.geom_pos.T, boxed_rot
        if mirror:
            # The image of every vector and rotation; an axis is a pseudovector.
            pos, anchor, axis = VECTOR * pos, VECTOR * anchor, -VECTOR * axis
            ipos, geom_pos = VECTOR * ipos, VECTOR * geom_pos
            rot, geom_rot = ROTATION * rot, ROTATION * geom_rot
        com = pos + rotate(rot, ipos)
        # A geom reaches as far as its rotated size triple, of which a sphere has only one entry.
        # This is not its true extent, but what descriptions are made of.
        box_rot = take_columns(rot, boxed_bodies)
        local = rotate(box_rot, take_columns(geom_pos, boxed))
        center = take_columns(pos, boxed_bodies) + local
        size = take_columns(e.geom_size.T, boxed)
        reach = jnp.abs(rotate(box_rot, rotate(geom_rot, size)))
        # The bounding box of spheres, feet, actuated joints and centres of mass.
        anchor, axis = take_columns(anchor, robot.actuated), take_columns(axis, robot.actuated)
        points = jnp.concatenate([anchor, com[:, 1:]], axis=-1)
        low = jnp.min(jnp.concatenate([center - reach, points], axis=-1), axis=-1, keepdims=True)
        high = jnp.max(jnp.concatenate([center + reach, points], axis=-1), axis=-1, keepdims=True)
        # Without a barrier XLA computes the whole tree again for every number that uses the box.
        low, high = jax.lax.optimization_barrier((low, high))
        spheres = slice(None, robot.num_spheres)
        feet = slice(robot.num_spheres, None)
        return Pose(
            rot=rot,
            com=com,
            anchor=anchor,
            axis=axis,
            spheres=center[:, spheres],
            sphere_radius=size[0, spheres],
            feet=center[:, feet],
            foot_size=size[:, feet],
            low=low,
            high=high,
            dimensions=(high - low)[:, 0],
        )

    return at_nominal
