"""The reward (Appendix A, "Reward function"): 23 terms T1 to T23 and how they are combined.

`t16_action_rate` is the paper's T16, and so on. Every function takes the `Moment` of one
environment and returns the unweighted T_i; `TERMS` has the weights. Joint and foot terms are means
over the robot's own joints and feet, so padding does not count.

Where the table leaves something open, the terms are:

- T9, joint nominal deviation: over all joints while the command is zero, over those of arms,
  head and waist otherwise (`randomization.keep_nominal`);
- T18, self-collision: the pairs in excess of those that the design has in its nominal pose;
- T20, foot air time: charged in every step on the ground, and with no wanted air time while the
  command is zero;
- T21, symmetric air: feet are paired by their mirrored y.

With these, the authors' published policies earn about what the paper reports (notebook 03).
"""

from collections.abc import Callable
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
    keep_nominal: jax.Array  # [J] 1 for joints that should, at this command
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


def t1_xy_velocity_tracking(m):
    """T1: exp(-|v_xy - c_xy|² / 0.25), of the IMU's velocity and the command in m/s."""
    error = m.readings.linear_velocity[:2] - m.command[:2]
    return jnp.exp(-jnp.sum(error**2) / TEMPERATURE)


def t2_yaw_velocity_tracking(m):
    """T2: exp(-(ω_z - c_ω)² / 0.25), rad/s."""
    return jnp.exp(-((m.readings.angular_velocity[2] - m.command[2]) ** 2) / TEMPERATURE)


def t3_alive_clipped(m):
    """T3: 1; penalties can use it up."""
    return jnp.ones(())


def t4_alive_unclipped(m):
    """T4: 1; `combine` adds it after clipping, so that nothing uses it up."""
    return jnp.ones(())


def t5_z_velocity(m):
    """T5: -v_z², (m/s)²."""
    return -(m.readings.linear_velocity[2] ** 2)


def t6_imu_acceleration(m):
    """T6: -|Δv / Δt|², (m/s²)², between two control steps."""
    change = m.readings.linear_velocity - m.last_linear_velocity
    return -jnp.sum((change / CONTROL_STEP) ** 2)


def t7_roll_pitch_velocity(m):
    """T7: -|ω_xy|², (rad/s)²."""
    return -jnp.sum(m.readings.angular_velocity[:2] ** 2)


def t8_roll_pitch_position(m):
    """T8: -(roll² + pitch²), rad²."""
    w, x, y, z = m.readings.imu_quat
    roll = jnp.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = jnp.arcsin(jnp.clip(2 * (w * y - z * x), -1, 1))
    return -(roll**2 + pitch**2)


def t9_joint_nominal_deviation(m):
    """T9: -mean (q - q_nominal)², rad², where joints that need not stay there count as 0."""
    deviation = (m.readings.joint_position - m.descriptions.nominal) * m.keep_nominal
    return -_joint_mean(deviation**2, m)


def t10_joint_position_limit(m):
    """T10: -mean of the excess over the soft limits, rad."""
    low, high = m.descriptions.soft_limits[:, 0], m.descriptions.soft_limits[:, 1]
    position = m.readings.joint_position
    return -_joint_mean(jax.nn.relu(low - position) + jax.nn.relu(position - high), m)


def t11_joint_velocity_limit(m):
    """T11: -mean of the excess over 90 % of the velocity limit, rad/s."""
    excess = jnp.abs(m.readings.joint_velocity) - 0.9 * m.descriptions.velocity_limits
    return -_joint_mean(jax.nn.relu(excess), m)


def t12_joint_velocity(m):
    """T12: -mean q̇², (rad/s)²."""
    return -_joint_mean(m.readings.joint_velocity**2, m)


def t13_joint_acceleration(m):
    """T13: -mean (Δq̇ / Δt)², (rad/s²)², between two control steps."""
    change = m.readings.joint_velocity - m.last_joint_velocity
    return -_joint_mean((change / CONTROL_STEP) ** 2, m)


def t14_joint_torque(m):
    """T14: -mean τ², (N m)²."""
    return -_joint_mean(m.readings.joint_torque**2, m)


def t15_positive_power(m):
    """T15: -mean of the power τ q̇ that motors put in, W."""
    return -_joint_mean(jax.nn.relu(m.readings.joint_torque * m.readings.joint_velocity), m)


def t16_action_rate(m):
    """T16: -mean (a_t - a_{t-1})²."""
    return -_joint_mean((m.actions[0] - m.actions[1]) ** 2, m)


def t17_action_smoothness(m):
    """T17: -mean (a_t - 2 a_{t-1} + a_{t-2})²."""
    return -_joint_mean((m.actions[0] - 2 * m.actions[1] + m.actions[2]) ** 2, m)


def t18_self_collision(m):
    """T18: minus the pairs of spheres that overlap, beyond those of the nominal pose."""
    return -jax.nn.relu(m.collisions - m.descriptions.nominal_collisions)


def t19_base_height(m):
    """T19: -(h - h_nominal)², m², of the IMU above the floor."""
    return -((m.readings.imu_height - m.descriptions.imu_height) ** 2)


def t20_foot_air_time(m):
    """T20: mean over all feet of min(air time - wanted, 0), s, with 0 for feet in the air.

    0.4 s are wanted per metre of mean robot dimension, none while the command is zero.
    """
    standing = jnp.all(m.command == 0)
    wanted = AIR_TIME_PER_METRE * jnp.mean(m.descriptions.dimensions)
    wanted = jnp.where(standing, 0.0, wanted)
    # Charged in every step on the ground, not at touch-down alone.
    return _foot_mean(m.contact * jnp.minimum(m.air_time - wanted, 0.0), m)


def t21_symmetric_air(m):
    """T21: minus the share of the pairs of mirrored feet that are both in the air."""
    air = 1 - m.contact
    pairs = m.descriptions.foot_pairs
    return -jnp.sum(pairs * air[:, None] * air[None]) / jnp.maximum(jnp.sum(pairs), 1.0)


def t22_foot_slip(m):
    """T22: -mean over all feet of |v_xy|², (m/s)², with 0 for feet in the air."""
    return -_foot_mean(m.contact * jnp.sum(m.readings.foot_velocity[:, :2] ** 2, -1), m)


def t23_foot_z_velocity(m):
    """T23: -mean min(v_z, 0)² of the feet, (m/s)²."""
    return -_foot_mean(jnp.minimum(m.readings.foot_velocity[:, 2], 0.0) ** 2, m)


@dataclass(frozen=True)
class Term:
    """One row of the paper's table of rewards: the term T_i and its weight w_i."""

    number: int  # i, from 1
    name: str
    weight: float  # w_i
    function: Callable[[Moment], jax.Array]


TERMS = (
    Term(1, "x-y velocity tracking", 2.0, t1_xy_velocity_tracking),
    Term(2, "yaw velocity tracking", 1.0, t2_yaw_velocity_tracking),
    Term(3, "alive (clipped)", 0.05, t3_alive_clipped),
    Term(4, "alive (unclipped)", 0.05, t4_alive_unclipped),
    Term(5, "z velocity", 2.0, t5_z_velocity),
    Term(6, "IMU acceleration", 1e-4, t6_imu_acceleration),
    Term(7, "roll-pitch velocity", 0.05, t7_roll_pitch_velocity),
    Term(8, "roll-pitch position", 10.0, t8_roll_pitch_position),
    Term(9, "joint nominal deviation", 20.0, t9_joint_nominal_deviation),
    Term(10, "joint position limit", 40.0, t10_joint_position_limit),
    Term(11, "joint velocity limit", 5.0, t11_joint_velocity_limit),
    Term(12, "joint velocity", 4e-4, t12_joint_velocity),
    Term(13, "joint acceleration", 5e-6, t13_joint_acceleration),
    Term(14, "joint torque", 4e-4, t14_joint_torque),
    Term(15, "positive power", 4e-4, t15_positive_power),
    Term(16, "action rate", 3.0, t16_action_rate),
    Term(17, "action smoothness", 0.1, t17_action_smoothness),
    Term(18, "self-collision", 2.0, t18_self_collision),
    Term(19, "base height", 30.0, t19_base_height),
    Term(20, "foot air time", 3.0, t20_foot_air_time),
    Term(21, "symmetric air", 1.0, t21_symmetric_air),
    Term(22, "foot slip", 0.1, t22_foot_slip),
    Term(23, "foot z velocity", 0.2, t23_foot_z_velocity),
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
