"""The axes of the small rotations in Φ: random directions that no design changes.

A design turns the inertia frame of every body, every body and every joint axis by an angle. The
directions about which they turn are not part of f (the paper does not mention them): they are drawn
once, and Φ is smooth in f. In the authors' published designs they are drawn from a generator whose
seed comes from f itself; `published_axes` returns these.
"""

from __future__ import annotations

import numpy as np

from shapebody.arguments import require_array, require_integer, require_kind, single
from shapebody.robot.robot import Robot, require_robot

MOST_BODIES = 10**6


def rotation_axes(generator: np.random.Generator, joint_axes: np.ndarray, num_bodies: int):
    """Directions of the rotations in Φ, drawn from `generator`.

    Args:
        generator: such as numpy.random.default_rng(0).
        joint_axes: float [nj, 3], the reference's unit joint axes.
        num_bodies: nb, at least 1.

    Returns:
        Unit vectors (inertia [nb, 3], body [nb, 3], joint [nj, 3]), the last perpendicular to
        `joint_axes`.
    """
    require_kind("generator", generator, np.random.Generator, "numpy.random.default_rng(0)")
    joint_axes = require_array("joint_axes", joint_axes, ("nj", 3))
    require_integer("num_bodies", num_bodies, 1, MOST_BODIES)
    inertia = _normalized(generator.normal(size=(num_bodies, 3)))
    body = _normalized(generator.normal(size=(num_bodies, 3)))
    angle = generator.uniform(0, 2 * np.pi, size=(len(joint_axes), 1))
    # A first perpendicular direction: the axis' two larger components exchanged, one negated.
    rows = np.arange(len(joint_axes))
    smallest = np.argmin(np.abs(joint_axes), axis=1)
    following, last = (smallest + 1) % 3, (smallest + 2) % 3
    first = np.zeros_like(joint_axes)
    first[rows, following] = joint_axes[rows, last]
    first[rows, last] = -joint_axes[rows, following]
    first = _normalized(first)
    joint = np.cos(angle) * first + np.sin(angle) * np.cross(joint_axes, first)
    return inertia, body, joint


def published_axes(robot: Robot, f):
    """Rotation axes (inertia, body, joint) that the published design f [d] was built with."""
    require_array("f", f, (require_robot(robot).design_dim,))
    generator = np.random.default_rng(published_axes_seed(f))
    return rotation_axes(generator, robot.model.jnt_axis[robot.joints], robot.num_bodies)


def published_axes_seed(f) -> int:
    """The generator seed that the published designs derive from their own f [d] (float32)."""
    f = require_array("f", single(require_array("f", f)))
    total = abs(float(np.sum(f.astype(np.float64))))
    return int(total * 1e6) ^ 0x5A5A5A5A


def _normalized(vectors):
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
