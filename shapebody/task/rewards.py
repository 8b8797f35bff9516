"""The 23 reward terms of Appendix A: one short function each, weights in one table.

Every function takes the `Moment` of one environment and returns the unweighted T_i of
the paper's table. Joint and foot terms are means over the robot's own joints and feet,
so padding does not count.

Where the table leaves something open, the terms are:

- joint nominal deviation: over all joints while the command is zero, over those of arms and head
  otherwise (`randomization.keep_nominal`);
- self collision: the pairs in excess of those that the design has in its nominal pose;
- foot air time: charged in every step on the ground, and with no wanted air time while the command
  is zero;
- symmetric air: feet are paired by their mirrored y.

With these, the authors' published policies earn about what the paper reports (notebook 02).
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from shapebody.arguments import require_shape
from shapebody.design.descriptions import Descriptions
from shapebody.task.config import CONTROL_STEP
from shapebody.task.sensors import Readings

TEMPERATURE = 0.25
"""Width of the two tracking rewards, (m/s)^2."""

AIR_TIME_PER_METRE = 0.4
"""Wanted air time of a foot, seconds per metre of mean robot dimension."""


class Moment(NamedTuple):
    """All that the reward of one control step depends on, for one environment."""

    readings: Readings
    descriptions: Descriptions
    command: jax.Array  # [3] vx, vy m/s and yaw rate rad/s
    keep_nominal: jax.Array  # [J] 0/1
    actions: jax.Array  # [3, J] this action, the last and the one before
    contact: jax.Array  # [F] 0/1
    air_time: jax.Array  # [F] s, before this step
    last_joint_velocity: jax.Array  # [J]
    last_linear_velocity: jax.Array  # [3]
    collisions: jax.Array  # [] overlapping pairs of collision spheres


def _mean(values, mask):
    return jnp.sum(values * mask) / jnp.maximum(jnp.sum(mask), 1.0)


def _joint_mean(values, m: Moment):
    return _mean(values, m.descriptions.joint_mask)


def _foot_mean(values, m: Moment):
    return _mean(values, m.descriptions.foot_mask)


def xy_velocity_tracking(m):
    error = m.readings.linear_velocity[:2] - m.command[:2]
    return jnp.exp(-jnp.sum(error**2) / TEMPERATURE)


def yaw_velocity_tracking(m):
    return jnp.exp(-((m.readings.angular_velocity[2] - m.command[2]) ** 2) / TEMPERATURE)


def alive(m):
    return jnp.ones(())


def z_velocity(m):
    return -(m.readings.linear_velocity[2] ** 2)


def imu_acceleration(m):
    change = m.readings.linear_velocity - m.last_linear_velocity
    return -jnp.sum((change / CONTROL_STEP) ** 2)


def roll_pitch_velocity(m):
    return -jnp.sum(m.readings.angular_velocity[:2] ** 2)


def roll_pitch_position(m):
    w, x, y, z = m.readings.imu_quat
    roll = jnp.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = jnp.arcsin(jnp.clip(2 * (w * y - z * x), -1, 1))
    return -(roll**2 + pitch**2)


def joint_nominal_deviation(m):
    deviation = (m.readings.joint_position - m.descriptions.nominal) * m.keep_nominal
    return -_joint_mean(deviation**2, m)


def joint_position_limit(m):
    low, high = m.descriptions.soft_limits[:, 0], m.descriptions.soft_limits[:, 1]
    position = m.readings.joint_position
    return -_joint_mean(jax.nn.relu(low - position) + jax.nn.relu(position - high), m)


def joint_velocity_limit(m):
    excess = jnp.abs(m.readings.joint_velocity) - 0.9 * m.descriptions.velocity_limits
    return -_joint_mean(jax.nn.relu(excess), m)


def joint_velocity(m):
    return -_joint_mean(m.readings.joint_velocity**2, m)


def joint_acceleration(m):
    change = m.readings.joint_velocity - m.last_joint_velocity
    return -_joint_mean((change / CONTROL_STEP) ** 2, m)


def joint_torque(m):
    return -_joint_mean(m.readings.joint_torque**2, m)


def positive_power(m):
    return -_joint_mean(jax.nn.relu(m.readings.joint_torque * m.readings.joint_velocity), m)


def action_rate(m):
    return -_joint_mean((m.actions[0] - m.actions[1]) ** 2, m)


def action_smoothness(m):
    return -_joint_mean((m.actions[0] - 2 * m.actions[1] + m.actions[2]) ** 2, m)


def self_collision(m):
    return -jax.nn.relu(m.collisions - m.descriptions.nominal_collisions)


def base_height(m):
    return -((m.readings.imu_height - m.descriptions.imu_height) ** 2)


def foot_air_time(m):
    standing = jnp.all(m.command == 0)
    wanted = AIR_TIME_PER_METRE * jnp.mean(m.descriptions.dimensions)
    wanted = jnp.where(standing, 0.0, wanted)
    # Charged in every step on the ground, not at touch-down alone.
    return _foot_mean(m.contact * jnp.minimum(m.air_time - wanted, 0.0), m)


def symmetric_air(m):
    air = 1 - m.contact
    pairs = m.descriptions.foot_pairs
    return -jnp.sum(pairs * air[:, None] * air[None]) / jnp.maximum(jnp.sum(pairs), 1.0)


def foot_slip(m):
    return -_foot_mean(m.contact * jnp.sum(m.readings.foot_velocity[:, :2] ** 2, -1), m)


def foot_z_velocity(m):
    return -_foot_mean(jnp.minimum(m.readings.foot_velocity[:, 2], 0.0) ** 2, m)


@dataclass(frozen=True)
class Term:
    """One row of the reward table."""

    name: str
    weight: float
    function: callable


TERMS = (
    Term("x-y velocity tracking", 2.0, xy_velocity_tracking),
    Term("yaw velocity tracking", 1.0, yaw_velocity_tracking),
    Term("alive (clipped)", 0.05, alive),
    Term("alive (unclipped)", 0.05, alive),
    Term("z velocity", 2.0, z_velocity),
    Term("IMU acceleration", 1e-4, imu_acceleration),
    Term("roll-pitch velocity", 0.05, roll_pitch_velocity),
    Term("roll-pitch position", 10.0, roll_pitch_position),
    Term("joint nominal deviation", 20.0, joint_nominal_deviation),
    Term("joint position limit", 40.0, joint_position_limit),
    Term("joint velocity limit", 5.0, joint_velocity_limit),
    Term("joint velocity", 4e-4, joint_velocity),
    Term("joint acceleration", 5e-6, joint_acceleration),
    Term("joint torque", 4e-4, joint_torque),
    Term("positive power", 4e-4, positive_power),
    Term("action rate", 3.0, action_rate),
    Term("action smoothness", 0.1, action_smoothness),
    Term("self-collision", 2.0, self_collision),
    Term("base height", 30.0, base_height),
    Term("foot air time", 3.0, foot_air_time),
    Term("symmetric air", 1.0, symmetric_air),
    Term("foot slip", 0.1, foot_slip),
    Term("foot z velocity", 0.2, foot_z_velocity),
)
"""T1 to T23 in the paper's order."""


def reward_terms(moment: Moment) -> jax.Array:
    """T1..T23 of one environment, float32[23], unweighted."""
    return jnp.stack([term.function(moment) for term in TERMS])


def combine(terms: jax.Array, coefficient: jax.Array) -> jax.Array:
    """The reward r_t from T1..T23 (last axis) and the curriculum coefficient (Appendix A).

    max(w1 T1 + w2 T2 + c (w3 T3 + w5 T5 + ... + w23 T23), 0) + c w4 T4, with every weight
    multiplied by the control step.
    """
    require_shape("terms", terms, ("...", len(TERMS)))
    weighted = terms * jnp.array([term.weight * CONTROL_STEP for term in TERMS])
    rest = weighted[..., 2] + jnp.sum(weighted[..., 4:], -1)
    clipped = jax.nn.relu(weighted[..., 0] + weighted[..., 1] + coefficient * rest)
    return clipped + coefficient * weighted[..., 3]
