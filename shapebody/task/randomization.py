"""Everything that is drawn at random: designs, commands, initial states, delay, pushes.

All functions but `draw_designs` treat one environment; `batch` maps them over all of them.
"""

from functools import partial

import jax
import jax.numpy as jnp

from shapebody.design.descriptions import Descriptions
from shapebody.rotations import quaternion_of_euler
from shapebody.task.config import TaskConfig


def command_limit(config: TaskConfig, descriptions: Descriptions):
    """Largest commanded velocity of a design, m/s."""
    if config.command_limit is not None:
        return jnp.full_like(descriptions.home_height, config.command_limit)
    return jnp.minimum(1.0, 2.0 * jnp.mean(descriptions.dimensions))


def draw_command(config: TaskConfig, key, limit):
    """A new command (vx, vy m/s, yaw rate rad/s), float32[3], each within +-limit."""
    velocity_key, all_key, single_key = jax.random.split(key, 3)
    command = jax.random.uniform(velocity_key, (3,), minval=-1.0, maxval=1.0) * limit
    command = jnp.where(jnp.abs(command) < config.command_dead_zone * limit, 0.0, command)
    stand = jax.random.uniform(all_key) < config.command_all_zero
    single = jax.random.uniform(single_key, (3,)) < config.command_single_zero
    return jnp.where(stand | single, 0.0, command)


def keep_nominal(descriptions: Descriptions, command):
    """Which joints should stay at their nominal position, float32[J]: the robot's arms and
    head always, every joint while the command is to stand."""
    standing = jnp.all(command == 0.0)
    return jnp.where(standing, descriptions.joint_mask, descriptions.keep_nominal)


def initial_pose(config: TaskConfig, key, descriptions: Descriptions, coefficient):
    """Initial trunk orientation (w, x, y, z) and joint positions, float32[4] and [J]."""
    angle_key, factor_key, offset_key = jax.random.split(key, 3)
    widths = jnp.array([config.initial_tilt, config.initial_tilt, config.initial_yaw])
    angles = jax.random.uniform(angle_key, (3,), minval=-1.0, maxval=1.0)
    quat = quaternion_of_euler(coefficient * widths * angles)
    shape = descriptions.nominal.shape
    factor = jax.random.uniform(factor_key, shape, minval=-1.0, maxval=1.0)
    offset = jax.random.uniform(offset_key, shape, minval=-1.0, maxval=1.0)
    joints = descriptions.nominal * (1 + coefficient * config.initial_joint_factor * factor)
    joints = joints + coefficient * config.initial_joint_offset * offset
    low, high = descriptions.soft_limits[:, 0], descriptions.soft_limits[:, 1]
    joints = jnp.minimum(jnp.maximum(joints, low), high)
    return quat, joints * descriptions.joint_mask


def draw_delay(config: TaskConfig, key):
    """(delay, mixed) of an episode: 0 or 1 control steps, and whether it is redrawn every step."""
    if config.action_delay is not None:
        return jnp.asarray(config.action_delay, jnp.int32), jnp.asarray(False)
    delay_key, mixed_key = jax.random.split(key)
    delay = jax.random.bernoulli(delay_key, config.delay_probability).astype(jnp.int32)
    return delay, jax.random.uniform(mixed_key) < config.mixed_delay


def delayed_action(config: TaskConfig, key, actions, delay, mixed, coefficient):
    """The action [J] that reaches the motors now; `actions` is [3, J], newest first."""
    if config.action_delay is None:
        delay = jnp.where(mixed, jax.random.bernoulli(key).astype(jnp.int32), delay)
    late = (delay == 1) & (coefficient > 0)
    return jnp.where(late, actions[1], actions[0])


def push(config: TaskConfig, key, trunk_velocity, total_mass, coefficient):
    """The trunk velocity [6] (m/s, rad/s) after a possible push; total_mass: kg."""
    if config.push_probability == 0.0:
        return trunk_velocity
    when_key, size_key, add_key = jax.random.split(key, 3)
    largest = jnp.minimum(config.push_per_mass * total_mass, config.push_limit)
    kick = jax.random.uniform(size_key, (6,), minval=-1.0, maxval=1.0) * largest * coefficient
    added = trunk_velocity + kick
    replaced = coefficient * kick + (1 - coefficient) * trunk_velocity
    pushed = jnp.where(jax.random.uniform(add_key) < config.push_add, added, replaced)
    happens = jax.random.uniform(when_key) < config.push_probability
    return jnp.where(happens, pushed, trunk_velocity)


@partial(jax.jit, static_argnums=(2, 3))
def draw_designs(keys, coefficients, dim: int, radius: tuple[float, float]):
    """f ~ U([-rc, rc]^d) (Section 3.1), float32 [n, d], with r uniform between `radius`.

    keys, coefficients: [n], one per design; dim: d.
    """

    def draw(key, c):
        design = jax.random.uniform(jax.random.fold_in(key, 7), (dim,), minval=-1.0, maxval=1.0)
        low, high = radius
        r = jax.random.uniform(jax.random.fold_in(key, 8), minval=low, maxval=high)
        return design * (c * r)

    return jax.vmap(draw)(keys, coefficients)


@partial(jax.jit, static_argnums=0)
def following_designs(config: TaskConfig, keys, coefficients, designs, fell):
    """Designs [n, d] of the episodes that follow: drawn anew, or, after some falls, the same.

    keys, coefficients: [n], of the new episodes; designs: [n, d] of those that ended; fell:
    bool [n], how.
    """
    new = draw_designs(keys, coefficients, designs.shape[-1], config.design_radius)
    if config.repeat_after_fall == 0.0:
        return new
    draw = jax.vmap(lambda key: jax.random.uniform(jax.random.fold_in(key, 9)))
    again = fell & (draw(keys) < config.repeat_after_fall)
    return jnp.where(again[:, None], designs, new)
