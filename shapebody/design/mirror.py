"""The mirror image of a body, across the x-z plane of its trunk.

For networks that are told the body, the image of a body is just another body, on which a policy
should do the mirrored thing. With M = diag(1, -1, 1), the image of a position or a velocity p is
M p, of a rotation R it is M R M, and of a pseudovector, such as a joint axis a or an angular
velocity, it is -M a. A joint with the image of its axis has the same angle, range and torque.

But if the left and the right hip of a robot turn about (1, 0, 0), those of its image turn about
(-1, 0, 0), which no body of that robot does. A joint may be reversed: axis -a, angle -q and range
(-high, -low) say the same of the same body. So each joint of the image is reversed if that gives it
the axis of its partner, the joint of the reference at its place (`mirror_signs`). The image of a
symmetric robot then has the same joints as the robot, in another order.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from shapebody.robot.robot import Robot, require_robot

if TYPE_CHECKING:
    from shapebody.design.descriptions import Descriptions

VECTOR = np.array([[1.0], [-1.0], [1.0]], np.float32)
"""The diagonal of M, [3, 1]: signs of the columns of vectors [3, n]."""
ROTATION = (VECTOR @ VECTOR.T)[..., None]
"""[3, 3, 1]: signs of the entries of rotations [3, 3, n] in M R M."""

AXIS_WEIGHT = 0.5
"""What a right angle between two axes counts in the search for partners, in lengths of the robot:
several joints may be at one place."""

_AXIS, _NOMINAL, _RANGE = slice(3, 6), 14, slice(21, 23)  # columns of a joint's description


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Mirrored:
    """What the networks are told of the mirror image of a body, like fields of `Descriptions`."""

    sign: jax.Array  # [J] -1 for joints of the image that are reversed, 1 for others, 0 for padding
    joints: jax.Array  # [J, 30]
    feet: jax.Array  # [F, 21]
    static: jax.Array  # [14]


def mirror_signs(robot: Robot) -> np.ndarray:
    """Which actuated joints are reversed in the mirror image of a robot, float32 [nu], -1 or 1.

    The partner of a joint is the one whose place in the reference's home pose is nearest to the
    joint's image, and whose axis is most parallel. The image's axis is to point where its does.
    """
    model, data = require_robot(robot).model, mujoco.MjData(robot.model)
    data.qpos[:] = robot.home
    mujoco.mj_kinematics(model, data)
    trunk = data.xmat[robot.trunk].reshape(3, 3)
    joints = robot.joints[robot.actuated]
    place = (data.xanchor[joints] - data.xpos[robot.trunk]) @ trunk
    axis = data.xaxis[joints] @ trunk
    image, image_axis = place * VECTOR[:, 0], -axis * VECTOR[:, 0]
    length = max(np.ptp(np.concatenate([place, image]), axis=0).max(), 1e-9)
    distance = np.linalg.norm(image[:, None] - place[None], axis=-1) / length
    along = image_axis @ axis.T
    partner = np.argmin(distance + AXIS_WEIGHT * (1 - np.abs(along)), axis=1)
    return np.where(along[np.arange(len(joints)), partner] < 0, -1, 1).astype(np.float32)


def reversed_joints(joints, sign):
    """Descriptions [..., J, 30] of the same joints, reversed where `sign` [..., J] is -1."""
    turned = sign[..., None]
    return jnp.concatenate(
        [
            joints[..., :3],
            joints[..., _AXIS] * turned,
            joints[..., _AXIS.stop : _NOMINAL],
            joints[..., _NOMINAL : _NOMINAL + 1] * turned,
            joints[..., _NOMINAL + 1 : _RANGE.start],
            _reversed_range(joints[..., _RANGE], turned),
            joints[..., _RANGE.stop :],
        ],
        axis=-1,
    )


def _reversed_range(limits, sign):
    """Ranges [..., 2] of joints, (-high, -low) where the sign [..., 1] is -1."""
    return jnp.where(sign < 0, -limits[..., ::-1], limits)


def mirrored(descriptions: Descriptions) -> Descriptions:
    """The descriptions of the mirror image of a body, [...] as these; twice is the identity.

    Raises:
        ValueError: if they were made without `describe(..., mirror=True)`.
    """
    image = descriptions.mirrored
    if image is None:
        raise ValueError(
            "these descriptions know no mirror image; make them with describe(robot, mirror=True)"
        )
    return dataclasses.replace(
        descriptions,
        joints=image.joints,
        feet=image.feet,
        static=image.static,
        nominal=descriptions.nominal * image.sign,
        soft_limits=_reversed_range(descriptions.soft_limits, image.sign[..., None]),
        mirrored=Mirrored(image.sign, descriptions.joints, descriptions.feet, descriptions.static),
    )
