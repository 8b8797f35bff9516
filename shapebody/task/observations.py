"""Observations of one environment (Appendix A), most of them scaled by constants (`SCALES`)."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from shapebody.design.descriptions import Descriptions
from shapebody.rotations import up_axis
from shapebody.task.config import TaskConfig
from shapebody.task.sensors import Readings


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Observation:
    """What the networks see of the state (leading axes allowed); all within [-10, 10].

    joints: position - nominal, velocity, last action, keep-nominal flag. feet (critic only):
    contact, time on the ground, time in the air. general: angular velocity 3,
    command 3, gait clock 4, gravity direction 3. privileged (critic only): linear velocity 3,
    height 1, curriculum coefficient 1.
    """

    joints: jax.Array  # [J, 4]
    feet: jax.Array  # [F, 3]
    general: jax.Array  # [13]
    privileged: jax.Array  # [5]


COMMAND = slice(3, 6)
"""Where the command is in the general observations."""

SCALES = {
    "joint_position": 6.5,  # rad, of the difference from the nominal position
    "joint_velocity": 180.0,  # rad/s
    "action": 10.0,
    "angular_velocity": 50.0,  # rad/s, clipped to +-1
    "foot_time": 2.5,  # s: times from 0 to 5 s become -1 to 1, and are clipped there
    "linear_velocity": 10.0,  # m/s, clipped to +-1
    "height": 5.0,  # m: heights from 0 to 10 m become -1 to 1, and are clipped there
}
"""What observations are divided by. The first four, which the policy sees, are those of the
authors' published policies, and so is the gait clock, which the paper does not mention. The others
follow the authors' earlier environment."""

LIMIT = 10.0
"""Every observation is clipped to +-this."""


_GENERAL = np.array([-1, 1, -1, 1, -1, -1, -1, -1, -1, -1, 1, -1, 1], np.float32)
_PRIVILEGED = np.array([1, -1, 1, 1, 1], np.float32)


def mirrored_observation(observation: Observation, sign) -> Observation:
    """What the mirror image of a body observes where the body observes this (`design.mirror`).

    Joints that are reversed have the opposite position, velocity and action; the gait clock is half
    a period later, when left and right have changed their parts.

    Args:
        sign: [..., J], -1 for reversed joints, of `Descriptions.mirrored`.
    """
    joints = observation.joints
    turned = joints[..., :3] * sign[..., None]
    return Observation(
        joints=jnp.concatenate([turned, joints[..., 3:]], -1),
        feet=observation.feet,
        general=observation.general * _GENERAL,
        privileged=observation.privileged * _PRIVILEGED,
    )


def foot_contact(readings: Readings, descriptions: Descriptions):
    """Which feet touch the floor, float32[F]: a foot's lowest point is below z = 0."""
    # How far the half-extents of a box reach down.
    box = jnp.sum(jnp.abs(readings.foot_down) * descriptions.foot_size, -1)
    extent = jnp.where(descriptions.foot_is_box > 0, box, descriptions.foot_size[..., 0])
    touching = readings.foot_position[..., 2] - extent < 0
    return touching.astype(jnp.float32) * descriptions.foot_mask


def sphere_collisions(readings: Readings, descriptions: Descriptions):
    """Number of overlapping pairs of the robot's collision spheres, float32[]."""
    position, radius, mask = (
        readings.sphere_position,
        descriptions.sphere_radius,
        descriptions.sphere_mask,
    )
    difference = position[:, None] - position[None]
    reach = radius[:, None] + radius[None]
    touching = jnp.sum(difference**2, -1) <= reach**2
    pairs = jnp.triu(mask[:, None] * mask[None], 1)
    return jnp.sum(touching * pairs)


def observe(
    config: TaskConfig,
    key,
    readings: Readings,
    descriptions: Descriptions,
    command,
    keep_nominal,
    last_action,
    clock,
    contact,
    ground_time,
    air_time,
    coefficient,
) -> Observation:
    """The observation of one environment.

    Args:
        key: PRNG key of the noise, whose widths `config` has and `coefficient` scales.
        command: [3]; keep_nominal: [J] 0/1; last_action: [J].
        clock: gait phase, rad.
        contact: [F] 0/1; ground_time, air_time: [F] s.
    """
    # Noise on what joints and the IMU measure.
    keys = jax.random.split(key, 4)
    mask = descriptions.joint_mask

    def noisy(key, value, width):
        noise = jax.random.uniform(key, value.shape, minval=-1.0, maxval=1.0)
        return value + coefficient * width * noise

    position = noisy(keys[0], readings.joint_position, config.noise_joint_position)
    velocity = noisy(keys[1], readings.joint_velocity, config.noise_joint_velocity)
    angular = noisy(keys[2], readings.angular_velocity, config.noise_angular_velocity)
    gravity = noisy(keys[3], -up_axis(readings.imu_quat), config.noise_gravity)

    # Normalized, joint by joint, foot by foot, and of the whole robot.
    scale = SCALES
    position = (position - descriptions.nominal) / scale["joint_position"]
    velocity, action = velocity / scale["joint_velocity"], last_action / scale["action"]
    joints = jnp.stack([position, velocity, action, keep_nominal], -1)
    on_ground = jnp.clip(ground_time / scale["foot_time"] - 1, -1, 1)
    in_air = jnp.clip(air_time / scale["foot_time"] - 1, -1, 1)
    feet = jnp.stack([2 * contact - 1, on_ground, in_air], -1)
    phases = jnp.stack([clock, clock - jnp.pi])
    angular = jnp.clip(angular / scale["angular_velocity"], -1, 1)
    general = jnp.concatenate([angular, command, jnp.sin(phases), jnp.cos(phases), gravity])
    linear = jnp.clip(readings.linear_velocity / scale["linear_velocity"], -1, 1)
    height = jnp.clip(readings.imu_height[None] / scale["height"] - 1, -1, 1)
    privileged = jnp.concatenate([linear, height, coefficient[None]])
    observation = Observation(
        joints=joints * mask[:, None],
        feet=feet * descriptions.foot_mask[:, None],
        general=general,
        privileged=privileged,
    )
    return jax.tree.map(lambda x: jnp.clip(jnp.nan_to_num(x), -LIMIT, LIMIT), observation)
