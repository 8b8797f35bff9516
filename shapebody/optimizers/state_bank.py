"""The states on which designs are judged (Section 3.2)."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np

from shapebody.agent.agent import Agent, require_agent
from shapebody.arguments import require_kind, require_shape
from shapebody.design.descriptions import Sizes
from shapebody.networks.inputs import GENERAL, PRIVILEGED
from shapebody.robot.robot import Robot, require_robot
from shapebody.task.observations import Observation


def bank(agent: Agent, robot: Robot) -> Observation:
    """The agent's states on which designs of `robot` are judged, in the robot's own sizes.

    For a robot that the agent was trained on, these are the states of that robot. Any other robot
    borrows all states of robots with at least as many joints and feet: its joint j is observed as
    joint j of the lender, and the joints it does not have are left out. States of smaller robots
    are not used, because padding is not an observation of a foot.

    Raises:
        ValueError: if no state fits.
    """
    require_agent(agent)
    require_robot(robot)
    if agent.states is None:
        raise ValueError(
            f"agent {agent.name!r} has no state bank; give states=, observations from rollouts of "
            "its policy"
        )
    states, owners = jax.tree.map(np.asarray, agent.states), np.asarray(agent.state_robots)
    if robot.name in agent.robots:
        chosen = owners == agent.robots.index(robot.name)
        if chosen.any():
            return trim(jax.tree.map(lambda x: x[chosen], states), robot)
    fitting = [
        index
        for index in range(len(agent.robots))
        if _used(states.joints[owners == index]) >= robot.num_actuators
        and _used(states.feet[owners == index]) >= robot.num_feet
    ]
    chosen = np.isin(owners, fitting)
    if not chosen.any():
        raise ValueError(
            f"agent {agent.name!r} (robots: {', '.join(agent.robots)}) has no states with the "
            f"{robot.num_actuators} joints and {robot.num_feet} feet of robot {robot.name!r}; use "
            "an agent trained on such a robot, or give states= from rollouts of its policy"
        )
    return trim(jax.tree.map(lambda x: x[chosen], states), robot)


def trim(states: Observation, robot: Robot) -> Observation:
    """States [M, ...] cut to the joints and feet of `robot`; ValueError if they have fewer."""
    require_kind("states", states, Observation, "observations such as agent.states")
    own = Sizes.of(robot)
    for name, columns in (("general", GENERAL), ("privileged", PRIVILEGED)):
        require_shape(f"states.{name}", getattr(states, name), ("M", columns))
    for name, needed in (("joints", own.joints), ("feet", own.feet)):
        shape = require_shape(f"states.{name}", getattr(states, name), None).shape
        if len(shape) != 3 or shape[0] == 0 or shape[1] < needed:
            raise ValueError(
                f"states.{name} has shape {shape}; robot {robot.name!r} needs at least one state "
                f"with {needed} {name}: [M, {needed} or more, ...]"
            )
    if (states.joints.shape[1], states.feet.shape[1]) == (own.joints, own.feet):
        return states
    return dataclasses.replace(
        states, joints=states.joints[:, : own.joints], feet=states.feet[:, : own.feet]
    )


def _used(parts: np.ndarray) -> int:
    """Number of parts [M, parts, n] that are not padding; padding is zero in every state."""
    present = np.flatnonzero(np.any(parts != 0, axis=(0, 2)))
    return int(present[-1]) + 1 if len(present) else 0
