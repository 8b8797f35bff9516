"""One episode of the frozen policy, control step by control step: for videos and for close looks.

`evaluate` keeps a few numbers of every episode; a `Recording` keeps everything of one.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from shapebody.agent.agent import Agent, require_agent
from shapebody.arguments import require_array, require_kind, require_number, require_seed
from shapebody.design.descriptions import Descriptions
from shapebody.design.space import DesignSpace
from shapebody.networks.policy import mean_action_policy
from shapebody.robot.robot import Robot
from shapebody.task import randomization
from shapebody.task.config import CONTROL_STEP, TaskConfig
from shapebody.task.env import Locomotion
from shapebody.task.observations import Observation
from shapebody.task.rewards import TERMS
from shapebody.task.sensors import Readings


@dataclass(frozen=True, eq=False)
class Recording:
    """T control steps of one robot; NumPy arrays, row t belongs to control step t."""

    qpos: np.ndarray
    """float64 [T, nq], positions at the beginning of the step."""
    observation: Observation
    """What the networks saw, with leading axis T."""
    action: np.ndarray
    """float32 [T, J], mean actions of the policy."""
    readings: Readings
    """Measurements at the end of the step, with leading axis T."""
    command: np.ndarray
    """float32 [T, 3], commanded vx, vy in m/s and yaw rate in rad/s."""
    contact: np.ndarray
    """float32 [T, F], 1 where a foot is on the floor at the end of the step."""
    terms: np.ndarray
    """float32 [T, 23], unweighted reward terms T1 to T23."""
    reward: np.ndarray
    """float32 [T]."""
    coefficient: float
    """Curriculum coefficient c."""
    ended: str
    """"horizon", "fell" or "not finite"."""
    descriptions: Descriptions
    """Descriptions of the design."""

    @property
    def time(self) -> np.ndarray:
        """float64 [T], seconds at the end of each step."""
        return CONTROL_STEP * np.arange(1, len(self.reward) + 1)

    @property
    def weighted_terms(self) -> np.ndarray:
        """float32 [T, 23], w_i T_i Δt, times c for all but the first two. The reward of a step is
        the sum of all but T4, clipped at 0, plus T4's."""
        scale = np.array([term.weight for term in TERMS]) * CONTROL_STEP
        scale[2:] *= self.coefficient
        return (self.terms * scale).astype(np.float32)


def record_episode(
    agent: Agent,
    robot: Robot,
    design=None,
    seconds: float = 6.0,
    command=None,
    seed: int = 0,
    coefficient: float = 1.0,
    task: TaskConfig | None = None,
) -> Recording:
    """Roll out the frozen policy with mean actions on one design, and keep every step.

    Runs in C MuJoCo on every machine. The same seed gives the same initial state, commands, noise
    and pushes to every design.

    Args:
        agent: its policy is used.
        robot: the robot whose design this is.
        design: normalized design [d] in [-1, 1]; the reference if not given.
        seconds: length of the recording; it is shorter if the episode ends before.
        command: (vx, vy, yaw rate) for the whole recording, in m/s and rad/s; drawn as the task
            draws it if not given.
        seed: of the episode.
        coefficient: curriculum coefficient c in [0, 1].
        task: settings of the task, those of the evaluation if not given.

    Raises:
        ValueError: for a design, command, length or coefficient that is not as described, or if
            the simulation becomes invalid in its first step.
    """
    # What is asked for.
    require_agent(agent)
    space = DesignSpace(robot)
    design = space.validate(space.reference if design is None else design)
    if design.ndim != 1:
        raise ValueError(f"design has shape {design.shape}; expected one design [{space.dim}]")
    require_number("coefficient", coefficient, 0, 1)
    require_number("seconds", seconds, CONTROL_STEP, hint="one control step, or more")
    require_seed("seed", seed)
    task = TaskConfig.evaluation() if task is None else task
    require_kind("task", task, TaskConfig, "TaskConfig.evaluation(...)")
    if command is not None:
        command = require_array("command (vx, vy, yaw rate)", command, (3,))
        task = dataclasses.replace(task, command_change=0.0)

    # The episode's start.
    env = _environment(robot, task)
    key = jax.random.PRNGKey(seed)
    state = env.reset(key, design, coefficient=coefficient, keys=key[None])
    if command is not None:
        state = _with_command(state, command)
    policy, embed = mean_action_policy(agent.policy_config)
    params = embed(agent.policy, state.descriptions)
    physics = env.groups[0].physics
    descriptions = jax.tree.map(lambda x: np.asarray(x)[0], state.descriptions)

    # Its control steps, until it ends. What the engine overwrites is copied.
    rows, ended = [], "horizon"
    for _ in range(min(round(seconds / CONTROL_STEP), task.horizon)):
        qpos, before = physics.qpos[0].copy(), np.asarray(state.command)[0]
        state, record, outcome = env.step(policy, params, state, key)
        if not record.finite[0]:
            ended = "not finite"
            break
        rows.append(
            (
                qpos,
                jax.tree.map(lambda x: x[0], record.observation),
                record.action[0],
                jax.tree.map(lambda x: np.asarray(x)[0], state.readings),
                before,
                np.asarray(state.contact)[0],
                np.asarray(outcome.terms)[0],
                record.reward[0],
            )
        )
        if record.terminated[0]:
            ended = "fell"
            break
    if not rows:
        raise ValueError("the simulation of this design became invalid in its first control step")
    stacked = jax.tree.map(lambda *x: np.stack(x), *rows)
    return Recording(*stacked, float(coefficient), ended, descriptions)


def _with_command(state, command):
    command = jnp.asarray(command, jnp.float32)[None]
    keep = jax.vmap(randomization.keep_nominal)(state.descriptions, command)
    return dataclasses.replace(state, command=command, keep_nominal=keep)


@functools.lru_cache(maxsize=4)
def _environment(robot: Robot, task: TaskConfig) -> Locomotion:
    # One simulation needs no second thread.
    return Locomotion(robot, 1, "native", task, auto_reset=False, threads=1)
