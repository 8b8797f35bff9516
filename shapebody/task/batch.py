"""A batch of episodes: environments of several robots side by side, with any physics engine.

Joints, feet and spheres are padded to the largest robot and masked, so that the formulas of
`episode` are mapped over all environments at once. Only what depends on the robot itself (its
physics, its sensors, the start of an episode) works on a `RobotGroup`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from shapebody.design.descriptions import Sizes, describe
from shapebody.design.kinematics import kinematics
from shapebody.design.space import DesignSpace
from shapebody.robot.robot import Robot
from shapebody.rotations import quaternion_product
from shapebody.task import episode as episodes
from shapebody.task import randomization
from shapebody.task.config import TaskConfig
from shapebody.task.episode import Episode
from shapebody.task.sensors import Readings, reader

RESET_SLOTS = 16
"""Finished environments are restarted in chunks of this size, so that one compiled
function serves any number of them."""


class RobotGroup:
    """The environments of one robot: a slice of the batch with its own physics.

    Attributes:
        robot, space: the robot and its design space.
        first, count, slice: which environments of the batch they are.
        physics: the engine that simulates them, `NativePhysics` or `MjxPhysics`.
        read: (qpos, qvel, sensordata, finite) of the engine -> `Readings`, padded.
        start: starts n episodes, (keys [n], designs [n, d], coefficients [n], streaks [n]) ->
            (Episode [n], Embodiment [n], qpos [n, nq], qvel [n, nv]).
        jitted_start: the same function, compiled.
        qvel_index: int [nu], where the velocities of the actuated joints are in qvel.
    """

    def __init__(
        self,
        robot: Robot,
        physics: Any,
        sizes: Sizes,
        first: int,
        count: int,
        config: TaskConfig,
        design_dim: int,
        mirror: bool = False,
    ):
        self.robot, self.physics = robot, physics
        self.first, self.count = first, count
        self.slice = slice(first, first + count)
        self.space = DesignSpace(robot)
        self.read = reader(robot, sizes)
        self.start = jax.vmap(_starter(robot, self.space, sizes, config, design_dim, mirror))
        self.jitted_start = jax.jit(self.start)
        self.qvel_index = np.asarray(robot.qvel_index)

    def owned(self, rows: np.ndarray) -> np.ndarray:
        """Which of the environments `rows` [R] are in this group, bool [R]."""
        return (rows >= self.first) & (rows < self.first + self.count)

    def bodies(self, designs):
        """Descriptions and embodiments of designs [S, d], as NumPy arrays.

        They come from the function that starts episodes, in chunks of its size, so that nothing
        is compiled for them and every bit is that of an episode.
        """
        designs = np.asarray(designs, np.float32)
        keys = np.asarray(jax.random.split(jax.random.PRNGKey(0), RESET_SLOTS))
        zeros = np.zeros(RESET_SLOTS, np.float32), np.zeros(RESET_SLOTS, np.int32)
        parts = []
        for at in range(0, len(designs), RESET_SLOTS):
            rows = np.minimum(np.arange(at, at + RESET_SLOTS), len(designs) - 1)
            state, embodiment, *_ = self.jitted_start(keys, designs[rows], *zeros)
            parts.append(jax.tree.map(np.asarray, (state.descriptions, embodiment)))
        return jax.tree.map(lambda *x: np.concatenate(x)[: len(designs)], *parts)


def _starter(robot: Robot, space, sizes, config: TaskConfig, design_dim: int, mirror: bool):
    """(key, design[d], coefficient, streak) -> (Episode, Embodiment, qpos, qvel)."""
    to_descriptions, forward = describe(robot, sizes, mirror), kinematics(robot)
    home = jnp.asarray(robot.home, jnp.float32)
    site_quat = jnp.asarray(robot.model.site_quat[robot.imu_site], jnp.float32)
    qpos_index = np.asarray(robot.qpos_index)
    feet, spheres = np.asarray(robot.feet), np.asarray(robot.spheres)

    def start(key, design, coefficient, streak):
        # The body, in a random pose around its nominal one.
        embodiment = space(design)
        d = to_descriptions(embodiment)
        pose_key, episode_key = jax.random.split(key)
        quat, joints = randomization.initial_pose(config, pose_key, d, coefficient)
        qpos = home.at[:2].set(0.0).at[2].set(d.home_height).at[3:7].set(quat)
        qpos = qpos.at[qpos_index].set(joints[: robot.num_actuators])

        # Put the centre of the lowest foot at floor height, as at the nominal pose.
        frames = forward(embodiment, qpos)
        lift = -jnp.min(frames.geom_pos[feet, 2])
        qpos = qpos.at[2].add(lift)
        rise = jnp.array([0.0, 0.0, 1.0]) * lift

        # What the sensors would read there, at rest, so that no physics step is needed.
        readings = Readings(
            joint_position=joints,
            joint_velocity=jnp.zeros(sizes.joints),
            joint_torque=jnp.zeros(sizes.joints),
            trunk_velocity=jnp.zeros(6),
            angular_velocity=jnp.zeros(3),
            linear_velocity=jnp.zeros(3),
            imu_height=frames.site_pos[robot.imu_site, 2] + lift,
            imu_quat=quaternion_product(quat, site_quat),
            foot_position=_padded(frames.geom_pos[feet] + rise, sizes.feet),
            foot_down=_padded(frames.geom_rot[feet, 2], sizes.feet),
            foot_velocity=jnp.zeros((sizes.feet, 3)),
            sphere_position=_padded(frames.geom_pos[spheres] + rise, sizes.spheres),
            finite=jnp.asarray(True),
        )
        stored = jnp.pad(design, (0, design_dim - space.dim))
        state = episodes.start(config, episode_key, stored, d, readings, coefficient, streak)
        return state, embodiment, qpos, jnp.zeros(robot.model.nv)

    return start


def _padded(x, length: int):
    """Zeros added to the first axis."""
    return jnp.pad(x, [(0, length - x.shape[0])] + [(0, 0)] * (x.ndim - 1))


# ------------------------------------------------------------------ all robots


@dataclass(frozen=True, eq=False)
class Batch:
    """N environments of one or more robots, and the task's part of a control step, mapped over
    all of them. The functions are pure; the loops of the engines compile them."""

    config: TaskConfig
    groups: tuple[RobotGroup, ...]
    auto_reset: bool
    """Whether a finished episode is followed by a new one."""

    def observe(self, state: Episode):
        """(state with the gait clocks advanced, Observation [N])."""
        return jax.vmap(partial(episodes.observe, self.config))(state)

    def control(self, state: Episode, action):
        """(state, joint targets [N, J] rad, trunk velocities [N, 6], joint velocities [N, J])
        after actions [N, J]; physics must start from these velocities."""
        return jax.vmap(partial(episodes.control, self.config))(state, action)

    def advance(self, state: Episode, raw):
        """Account for one control step of physics.

        Args:
            raw: for each group what its engine returned, (qpos, qvel, sensordata, finite).

        Returns:
            (state, Outcome [N], (coefficient [N], streak [N], keys [N]) of the episodes that would
            follow).
        """
        parts = [group.read(*out) for group, out in zip(self.groups, raw, strict=True)]
        readings = jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
        state, outcome = jax.vmap(partial(episodes.advance, self.config))(state, readings)
        coefficient, streak = jax.vmap(partial(episodes.next_coefficient, self.config))(
            state, outcome.terminated
        )
        return state, outcome, (coefficient, streak, _next_key(state.key))


@jax.jit
def _next_key(keys):
    """Each environment's key for its next episode, from its key for this one."""
    return jax.vmap(lambda key: jax.random.fold_in(key, 2**31 - 1))(keys)
