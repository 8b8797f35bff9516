"""Small robots and agents, quick to compile, for tests that need whole ones."""

import contextlib

import jax
import numpy as np

from shapebody.agent.agent import Agent
from shapebody.design.descriptions import Sizes
from shapebody.networks.config import CriticConfig, PolicyConfig
from shapebody.networks.critic import Critic
from shapebody.networks.inputs import initialize
from shapebody.networks.policy import Policy
from shapebody.robot.robot import load_robot
from shapebody.task.observations import Observation

LEG = """
      <body name="leg_{i}" pos="{x} {y} 0">
        <inertial pos="0 0 -0.1" mass="0.3" diaginertia="0.001 0.001 0.0008"/>
        <joint name="hip_{i}" axis="0 1 0" range="-1 1" damping="0.05" armature="0.001"/>
        <geom name="foot_{i}" type="sphere" size="0.02" pos="0 0 -0.28"/>
      </body>"""

ROBOT = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.005"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 0.05"/>
    <body name="trunk" pos="0 0 0.3">
      <freejoint name="root"/>
      <inertial pos="0 0 0" mass="2" diaginertia="0.02 0.03 0.04"/>
      <geom type="box" size="0.1 0.1 0.03" group="2"/>
      <geom name="sphere_0" type="sphere" size="0.08" group="5"/>
      <site name="imu"/>{legs}
    </body>
  </worldbody>
  <actuator>{actuators}
  </actuator>
  <keyframe><key name="home" qpos="0 0 0.3 1 0 0 0 {home}"/></keyframe>
  <custom>
    <numeric name="action_scale" data="0.3"/>
    <numeric name="velocity_limits" data="{velocities}"/>
  </custom>
</mujoco>
"""


def tiny_robot(folder, legs: int = 2):
    """A trunk on `legs` legs of one joint, named "legs_<number>"."""
    angles = 2 * np.pi * np.arange(legs) / legs
    bodies = [LEG.format(i=i, x=0.1 * np.sin(a), y=0.1 * np.cos(a)) for i, a in enumerate(angles)]
    actuators = [
        f'\n    <position name="hip_{i}" joint="hip_{i}" kp="20" kv="0.5" forcerange="-9 9"/>'
        for i in range(legs)
    ]
    path = folder / f"legs_{legs}.xml"
    path.write_text(
        ROBOT.format(
            legs="".join(bodies),
            actuators="".join(actuators),
            home=" ".join(["0.1"] * legs),
            velocities=" ".join(["10"] * legs),
        )
    )
    return load_robot(path)


@contextlib.contextmanager
def quick_compilation():
    """Programs compiled inside are little optimized: these tests compile more than they compute."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", before)


def tiny_critic_config(**changes) -> CriticConfig:
    sizes = dict(
        heads=2,
        joint_key_widths=(6,),
        joint_value_latent=3,
        foot_key_widths=(5,),
        foot_value_latent=2,
        head_widths=(12, 8),
        latent_scale=6.0,
    )
    return CriticConfig(**(sizes | changes))


def random_variables(module, rng):
    """Random parameters and identity constants, without compiling the real initialization."""

    def fill(place, leaf):
        name = place[-1].key
        if name == "mean":
            return np.zeros(leaf.shape, np.float32)
        values = rng.normal(size=leaf.shape) / np.sqrt(leaf.shape[-2] if leaf.ndim > 1 else 10)
        return np.asarray(values + (name == "scale") * (1 - values), np.float32)

    shapes = jax.eval_shape(lambda: initialize(module, jax.random.PRNGKey(0)))
    return jax.tree_util.tree_map_with_path(fill, shapes)


def tiny_agent(*robots, states: int = 24, seed: int = 0, critic: CriticConfig | None = None):
    """Random networks and random states, the same number of every robot."""
    sizes = Sizes.of(*robots)
    policy = PolicyConfig(
        key_widths=(8,), value_latent=2, core_widths=(12, 8), initial_temperature=0.5
    )
    critic = critic or tiny_critic_config()
    rng = np.random.default_rng(seed)
    owners = np.arange(states * len(robots)) % len(robots)

    def draw(*shape):
        return rng.normal(size=(len(owners), *shape)).astype(np.float32)

    bank = Observation(
        joints=draw(sizes.joints, 4), feet=draw(sizes.feet, 3), general=draw(13), privileged=draw(5)
    )
    for index, robot in enumerate(robots):
        own = owners == index
        bank.joints[own, robot.num_actuators :] = 0
        bank.feet[own, robot.num_feet :] = 0
    return Agent(
        name="tiny",
        robots=tuple(robot.name for robot in robots),
        sizes=sizes,
        policy_config=policy,
        critic_config=critic,
        policy=random_variables(Policy(policy), rng),
        critic=random_variables(Critic(critic), rng),
        states=bank,
        state_robots=owners,
        metadata={"steps": 0},
    )
