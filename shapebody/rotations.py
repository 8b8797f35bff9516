"""Quaternions and rotation matrices. Quaternions are unit, scalar part first: (w, x, y, z).

All formulas are elementwise sums and products, never matrix products, which accelerators round to
fewer digits. Arrays of n vectors, quaternions or matrices have n as their *last* axis, so that one
component of all of them lies together in memory; what differs says so.
"""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
import numpy as np


def quaternion_product(p, q):
    """Products p ⊗ q of quaternions [4, n]: the rotation q, then p."""
    return jnp.stack(
        [
            p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
            p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
            p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
            p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
        ]
    )


def turned(quaternions, axis, angle):
    """Quaternions [n, 4] after a further rotation by `angle` [n] rad about unit `axis` [n, 3]."""
    half = 0.5 * angle
    turn = jnp.concatenate([jnp.cos(half)[None], jnp.sin(half) * axis.T])
    return quaternion_product(turn, quaternions.T).T


def quaternion_of_euler(angles):
    """Quaternion [4] of rotations by `angles` [3] rad about the fixed x, then y, then z axis."""
    cx, cy, cz = jnp.cos(angles / 2)
    sx, sy, sz = jnp.sin(angles / 2)
    return jnp.stack(
        [
            cx * cy * cz + sx * sy * sz,
            sx * cy * cz - cx * sy * sz,
            cx * sy * cz + sx * cy * sz,
            cx * cy * sz - sx * sy * cz,
        ]
    )


def up_axis(quat):
    """The world's z axis in the frame of a quaternion: [..., 4] -> [..., 3]."""
    w, x, y, z = quat[..., 0], quat[..., 1], quat[..., 2], quat[..., 3]
    return jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1)


def rotation_matrices(q):
    """Rotation matrices [3, 3, n] of quaternions [4, n]."""
    w, x, y, z = q
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row) for row in rows])


def constant_matrices(quaternions) -> np.ndarray:
    """Rotation matrices, float32 [3, 3, n] in NumPy, of constant quaternions [n, 4]."""
    rotations = np.zeros((len(quaternions), 9))
    for rotation, quaternion in zip(rotations, quaternions, strict=True):
        mujoco.mju_quat2Mat(rotation, quaternion)
    return np.ascontiguousarray(np.moveaxis(rotations.reshape(-1, 3, 3), 0, -1), np.float32)


def rotate(rotation, vector):
    """Rotated vectors [3, n]: matrices [3, 3, n] times vectors [3, n]."""
    return rotation[:, 0] * vector[0] + rotation[:, 1] * vector[1] + rotation[:, 2] * vector[2]


def compose(first, second):
    """Products of rotation matrices, [3, 3, n] each."""
    return jnp.stack([rotate(first, second[:, column]) for column in range(3)], axis=1)
