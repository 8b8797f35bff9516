"""Quaternions, scalar part first."""

from __future__ import annotations

import jax.numpy as jnp


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
