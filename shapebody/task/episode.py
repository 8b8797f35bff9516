"""One episode as a pure state machine, independent of the physics engine.

    start -> [observe -> act -> control -> physics -> advance] x horizon

Every function treats one environment; `batch` maps it over all of them.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp

from shapebody.design.descriptions import Descriptions
from shapebody.task import curriculum, observations, randomization, rewards
from shapebody.task.config import CONTROL_STEP, GAIT_PERIOD, TaskConfig
from shapebody.task.sensors import Readings


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Episode:
    """The task's state of one environment; with the physics state it determines the future."""

    key: jax.Array  # PRNG key (uint32[2]) of this episode
    design: jax.Array  # [D] normalized design f, zero-padded
    descriptions: Descriptions
    readings: Readings
    coefficient: jax.Array  # [] curriculum coefficient c
    streak: jax.Array  # [] int32, successes (+) or failures (-) in a row
    step: jax.Array  # [] int32, control steps so far
    horizon: jax.Array  # [] int32, step at which the episode is cut
    command: jax.Array  # [3]
    keep_nominal: jax.Array  # [J] 1 for joints that should, at this command
    actions: jax.Array  # [3, J] newest first
    delay: jax.Array  # [] int32
    mixed_delay: jax.Array  # [] bool
    clock: jax.Array  # [] rad
    contact: jax.Array  # [F]
    ground_time: jax.Array  # [F] s
    air_time: jax.Array  # [F] s
    total_reward: jax.Array  # [] return so far
    total_error: jax.Array  # [] sum over steps of the mean per-axis |v_xy - c_xy|,
    # each at most twice the command limit


class Outcome(NamedTuple):
    """What `advance` reports of one control step."""

    reward: jax.Array  # []
    terms: jax.Array  # [23] unweighted T_i
    terminated: jax.Array  # [] bool: fell, was too fast, or became non-finite
    truncated: jax.Array  # [] bool: reached the horizon
    finite: jax.Array  # [] bool


def _random(episode: Episode, use: int):
    """A key for one use in one step: nothing is stored, so an episode replays exactly."""
    return jax.random.fold_in(jax.random.fold_in(episode.key, episode.step), use)


def start(
    config: TaskConfig,
    key,
    design,
    descriptions: Descriptions,
    readings: Readings,
    coefficient,
    streak,
) -> Episode:
    """A fresh episode of a design whose initial `readings` are given."""
    command_key, delay_key, episode_key = jax.random.split(key, 3)
    limit = randomization.command_limit(config, descriptions)
    command = randomization.draw_command(config, command_key, limit)
    delay, mixed = randomization.draw_delay(config, delay_key)
    zero = jnp.zeros(())
    joints, feet = descriptions.joint_mask.shape[0], descriptions.foot_mask.shape[0]
    return Episode(
        key=episode_key,
        design=design,
        descriptions=descriptions,
        readings=readings,
        coefficient=coefficient,
        streak=streak,
        step=jnp.zeros((), jnp.int32),
        horizon=jnp.asarray(config.horizon, jnp.int32),
        command=command,
        keep_nominal=randomization.keep_nominal(descriptions, command),
        actions=jnp.zeros((3, joints)),
        delay=delay,
        mixed_delay=mixed,
        clock=zero,
        contact=observations.foot_contact(readings, descriptions),
        ground_time=jnp.zeros(feet),
        air_time=jnp.zeros(feet),
        total_reward=zero,
        total_error=zero,
    )


def observe(config: TaskConfig, episode: Episode):
    """(episode with the gait clock advanced, its observation)."""
    clock = episode.clock + 2 * jnp.pi * CONTROL_STEP / GAIT_PERIOD
    clock = jnp.mod(clock + jnp.pi, 2 * jnp.pi) - jnp.pi
    observation = observations.observe(
        config,
        _random(episode, 0),
        episode.readings,
        episode.descriptions,
        episode.command,
        episode.keep_nominal,
        episode.actions[0],
        clock,
        episode.contact,
        episode.ground_time,
        episode.air_time,
        episode.coefficient,
    )
    return replace(episode, clock=clock), observation


def control(config: TaskConfig, episode: Episode, action):
    """Take an action [J]: (episode, joint targets [J] in rad, trunk velocity [6], joint
    velocities [J]). Physics must start from these velocities: the trunk's after a possible
    push, the joints' as the last step left them, within the design's limits."""
    action = jnp.clip(action, -10.0, 10.0) * episode.descriptions.joint_mask
    actions = jnp.stack([action, episode.actions[0], episode.actions[1]])
    applied = randomization.delayed_action(
        config,
        _random(episode, 1),
        actions,
        episode.delay,
        episode.mixed_delay,
        episode.coefficient,
    )
    target = episode.descriptions.nominal + episode.descriptions.action_scale * applied
    trunk = randomization.push(
        config,
        _random(episode, 2),
        episode.readings.trunk_velocity,
        episode.descriptions.total_mass,
        episode.coefficient,
    )
    episode = replace(episode, actions=actions)
    return episode, target, trunk, episode.readings.joint_velocity


def advance(config: TaskConfig, episode: Episode, readings: Readings):
    """Account for one control step of physics: (episode, Outcome)."""
    # What is read: the old values where physics failed, velocities clipped to their limits.
    d = episode.descriptions
    finite = readings.finite
    readings = jax.tree.map(
        lambda new, old: jnp.where(finite, new, old), readings, episode.readings
    )
    too_fast = jnp.asarray(False)
    if config.velocity_bound is not None:
        bound, trunk = config.velocity_bound, readings.trunk_velocity
        too_fast = jnp.any(jnp.abs(trunk) > bound)
        too_fast |= jnp.any(jnp.abs(readings.joint_velocity) > bound)
        readings = replace(readings, trunk_velocity=jnp.clip(trunk, -bound, bound))
    velocity = jnp.clip(readings.joint_velocity, -d.velocity_limits, d.velocity_limits)
    readings = replace(readings, joint_velocity=velocity, finite=finite)
    contact = observations.foot_contact(readings, d)

    # Reward; nothing for a step in which physics failed.
    moment = rewards.Moment(
        readings=readings,
        descriptions=d,
        command=episode.command,
        keep_nominal=episode.keep_nominal,
        actions=episode.actions,
        contact=contact,
        air_time=episode.air_time,
        last_joint_velocity=episode.readings.joint_velocity,
        last_linear_velocity=episode.readings.linear_velocity,
        collisions=observations.sphere_collisions(readings, d),
    )
    terms = rewards.reward_terms(moment)
    reward = jnp.where(finite, jnp.nan_to_num(rewards.combine(terms, episode.coefficient)), 0.0)

    # End: by a fall (the lower c, the sooner), too much speed, failed physics, or the horizon.
    step = episode.step + 1
    floor = (1 - episode.coefficient) * config.termination_height * d.imu_height
    terminated = ~finite | too_fast | (readings.imu_height < floor)
    truncated = (step >= episode.horizon) & ~terminated

    # Tracking error, by which the curriculum may judge the episode.
    limit = randomization.command_limit(config, d)
    difference = jnp.abs(readings.linear_velocity[:2] - episode.command[:2])
    error = jnp.mean(jnp.minimum(difference, 2 * limit))

    # The next command is drawn after this step's reward, before the next observation.
    change_key, command_key = jax.random.split(_random(episode, 3))
    new_command = randomization.draw_command(config, command_key, limit)
    change = jax.random.uniform(change_key) < config.command_change
    command = jnp.where(change, new_command, episode.command)

    episode = replace(
        episode,
        readings=readings,
        step=step,
        command=command,
        keep_nominal=randomization.keep_nominal(d, command),
        contact=contact,
        ground_time=jnp.where(contact > 0, episode.ground_time + CONTROL_STEP, 0.0),
        air_time=jnp.where(contact > 0, 0.0, episode.air_time + CONTROL_STEP),
        total_reward=episode.total_reward + reward,
        total_error=episode.total_error + error,
    )
    return episode, Outcome(reward, terms, terminated, truncated, finite)


def next_coefficient(config: TaskConfig, episode: Episode, terminated):
    """(coefficient, streak) for the episode that follows a finished one.

    terminated: bool, whether the finished one ended before its horizon.
    """
    old = episode.coefficient, episode.streak
    if config.fixed_coefficient:
        return old
    mean_error = episode.total_error / jnp.maximum(episode.step, 1)
    limit = randomization.command_limit(config, episode.descriptions)
    success = curriculum.is_success(config, mean_error, episode.step, limit, episode.total_reward)
    new = curriculum.update(config, *old, success)
    conclusive = curriculum.is_conclusive(config, episode.step, terminated)
    return tuple(jnp.where(conclusive, *pair) for pair in zip(new, old, strict=True))
