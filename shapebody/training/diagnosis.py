"""What a policy does on the robot as it is: whether it walks, only stands, or falls.

A return does not tell: a robot with many legs earns much by standing still. What tells is how much
of a commanded velocity the body has. Of a policy that walks it is most, of one that stands nothing.
"""

from __future__ import annotations

import functools
from typing import Literal, NamedTuple

import jax
import numpy as np

from shapebody.arguments import require_engine, require_kind
from shapebody.networks.config import PolicyConfig
from shapebody.networks.policy import mean_action_policy
from shapebody.robot.robot import Robot, require_robot
from shapebody.task.config import CONTROL_STEP, TaskConfig
from shapebody.task.env import Locomotion
from shapebody.task.observations import COMMAND, SCALES
from shapebody.training.update import require_variables

EPISODES, STEPS = 64, 500
"""Episodes of the diagnosis, and control steps of each at most: 10 s."""
TELLS_FROM = 1_000_000
"""Environment steps of training before which nothing is said: most policies do nothing yet."""
WALKS_FROM = 0.5
"""Response to commands from which a policy counts as walking."""
FALLS_WITHIN = 5.0
"""Seconds that half of the episodes must last, or the robot counts as falling."""

ADVICE = {
    "walks": "",
    "stands": (
        "Eight runs of the Golem stood like that for 3 to 10 million steps. What made it walk: a "
        "new run, under another name, with less noise and no reward for noise "
        "(--entropy-coefficient 0 --policy.initial-std 0.4 --policy.std-limits 0.2 2)."
    ),
    "falls": (
        "Train longer: a run of the MIT Humanoid still fell after 7 million steps. If nothing "
        "improves, look at what `python -m shapebody validate` says of torque limits, gains and "
        "the nominal pose."
    ),
}
"""What to do about each finding."""


class Diagnosis(NamedTuple):
    """How a policy walks with one robot."""

    robot: str
    """Name of the robot."""
    finding: Literal["walks", "stands", "falls"]
    """In one word."""
    response: float
    """Share of the commanded velocity that the body has: Σ v_xy · c_xy / Σ c_xy · c_xy over all
    control steps before a fall. 1 is perfect, 0 is standing still."""
    seconds: float
    """Median time until a fall, at most 10 s."""

    def sentence(self) -> str:
        """The finding, what it rests on, and what to do about it."""
        if self.finding == "falls":
            found = f"falls: half of its episodes end within {self.seconds:.1f} s."
        else:
            does = "walks" if self.finding == "walks" else "only stands"
            share = f"{max(self.response, 0.0):.0%} of the velocity that is commanded"
            found = f"{does}: it moves at {share}."
        return f"{self.robot} {found} {ADVICE[self.finding]}".rstrip()


def diagnose(config: PolicyConfig, policy, robot: Robot, engine: str = "auto") -> Diagnosis:
    """Play 64 undisturbed episodes of 10 s with the robot as it is (c = 0), with mean actions.

    Commands are up to 1 m/s, and every action is one control step late (`TaskConfig.evaluation`).
    The first call for a robot compiles for some seconds.

    Args:
        config, policy: sizes and variables of the policy, such as `agent.policy_config` and
            `agent.policy`.
        robot: the robot.
        engine: "native", "mjx" or "auto".
    """
    require_kind("config", config, PolicyConfig, "such as agent.policy_config")
    require_variables("policy", policy)
    require_robot(robot)
    require_engine("engine", engine)
    env = _environment(robot, engine)
    act, embed = mean_action_policy(config)
    key = jax.random.PRNGKey(0)
    state = env.reset(key, np.zeros(env.design_dim, np.float32), coefficient=0.0)
    state, episode = env.rollout(act, embed(policy, state.descriptions), state, key, STEPS)
    # Control steps before the end of each episode; what follows does not count.
    ended = np.cumsum(np.asarray(episode.terminated), axis=0) > 0
    alive = (~ended)[..., None]
    velocity = np.asarray(episode.observation.privileged)[..., :2] * SCALES["linear_velocity"]
    command = np.asarray(episode.observation.general)[..., COMMAND][..., :2]
    followed = np.sum(velocity * command, where=alive)
    response = float(followed / max(np.sum(command * command, where=alive), 1e-9))
    seconds = float(np.median(np.sum(~ended, axis=0))) * CONTROL_STEP
    finding = "falls" if seconds < FALLS_WITHIN else "stands"
    if finding == "stands" and response >= WALKS_FROM:
        finding = "walks"
    return Diagnosis(robot.name, finding, response, seconds)


@functools.lru_cache(maxsize=2)
def _environment(robot: Robot, engine: str) -> Locomotion:
    return Locomotion(robot, EPISODES, engine, TaskConfig.evaluation(), auto_reset=False)
