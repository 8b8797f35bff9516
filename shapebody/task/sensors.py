"""What the task reads from physics, in one padded layout for every robot and engine."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from shapebody.design.descriptions import Sizes
from shapebody.robot.robot import Robot
from shapebody.rotations import up_axis


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Readings:
    """One environment's measurements after a control step (leading axes allowed).

    Positions and velocities of joints are current; what comes from sensors describes
    the state before the last physics substep, as MuJoCo's `mj_step` leaves it.
    """

    joint_position: jax.Array  # [J] rad
    joint_velocity: jax.Array  # [J] rad/s
    joint_torque: jax.Array  # [J] N m
    trunk_velocity: jax.Array  # [6] free joint: linear (world), angular (trunk)
    angular_velocity: jax.Array  # [3] rad/s, IMU frame
    linear_velocity: jax.Array  # [3] m/s, IMU frame
    imu_height: jax.Array  # [] m
    imu_quat: jax.Array  # [4] w, x, y, z
    foot_position: jax.Array  # [F, 3] m, centres
    foot_down: jax.Array  # [F, 3] world z axis in the foot's frame
    foot_velocity: jax.Array  # [F, 3] m/s, world
    sphere_position: jax.Array  # [S, 3] m
    finite: jax.Array  # [] bool


def reader(robot: Robot, sizes: Sizes):
    """A function (qpos[N, nq], qvel[N, nv], sensordata[N, ns], finite[N]) -> Readings[N].

    It only slices and pads, so it can be traced for any engine's output.
    """
    take_qpos, take_qvel = _picker(robot.qpos_index), _picker(robot.qvel_index)
    sensors = robot.sensors

    def read(qpos, qvel, sensordata, finite) -> Readings:
        n = qpos.shape[0]

        def block(name, width, count=None, padded=None):
            values = sensordata[:, sensors[name]]
            if count is None:
                return values
            return _pad(values.reshape(n, count, width), padded)

        return Readings(
            joint_position=_pad(take_qpos(qpos), sizes.joints),
            joint_velocity=_pad(take_qvel(qvel), sizes.joints),
            joint_torque=_pad(block("actuator_forces", 1), sizes.joints),
            trunk_velocity=qvel[:, :6],
            angular_velocity=block("imu_angular_velocity", 3),
            linear_velocity=block("imu_linear_velocity", 3),
            imu_height=block("imu_position", 3)[:, 2],
            imu_quat=block("imu_orientation", 4),
            foot_position=block("foot_positions", 3, robot.num_feet, sizes.feet),
            foot_down=up_axis(block("foot_orientations", 4, robot.num_feet, sizes.feet)),
            foot_velocity=block("foot_velocities", 3, robot.num_feet, sizes.feet),
            sphere_position=block("sphere_positions", 3, robot.num_spheres, sizes.spheres),
            finite=finite,
        )

    return read


def _picker(index: np.ndarray):
    """Take columns; a slice where they are contiguous (gathers are slow on a CPU)."""
    index = np.asarray(index)
    if len(index) and np.array_equal(index, np.arange(index[0], index[0] + len(index))):
        return lambda x: x[:, index[0] : index[0] + len(index)]
    return lambda x: x[:, index]


def _pad(x, length: int):
    """Zero-pad axis 1 to `length`."""
    missing = length - x.shape[1]
    if missing == 0:
        return x
    return jnp.pad(x, [(0, 0), (0, missing)] + [(0, 0)] * (x.ndim - 2))
