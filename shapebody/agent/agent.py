"""A frozen policy and critic with what a design search needs beside them."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from flax.traverse_util import flatten_dict

from shapebody.arguments import require_kind
from shapebody.design.descriptions import Descriptions, Sizes
from shapebody.networks.config import CriticConfig, PolicyConfig
from shapebody.networks.critic import Critic
from shapebody.networks.inputs import require_inputs
from shapebody.networks.policy import Policy
from shapebody.task.observations import Observation


@dataclass(frozen=True, eq=False)
class Agent:
    """A frozen policy and critic with what a design search needs beside them.

    Attributes:
        name: name of the folder in `data/checkpoints`.
        robots: names of the robots it was trained on.
        sizes: numbers of joints, feet and spheres to which everything is padded.
        policy_config, critic_config: sizes of the networks; no critic's for an agent without one.
        policy, critic: variables of the networks, {"params": ..., "constants": ...}; critic None
            for a policy that has none, which can walk but not judge designs.
        states: the state bank of M states, an Observation with leading axis M, padded to `sizes`,
            float32; None if there is none.
        state_robots: int[M], index into `robots` of the robot that each state comes from.
        metadata: JSON-like facts about the training: configuration, scale, steps, seconds,
            versions, commit, machine.
    """

    name: str
    robots: tuple[str, ...]
    sizes: Sizes
    policy_config: PolicyConfig
    critic_config: CriticConfig | None
    policy: Any
    critic: Any | None
    states: Observation | None = None
    state_robots: np.ndarray | None = None
    metadata: dict = field(default_factory=dict)

    @functools.cached_property
    def policy_module(self) -> Policy:
        return Policy(self.policy_config)

    @functools.cached_property
    def critic_module(self) -> Critic:
        return Critic(self.critic_config)

    def act(self, descriptions: Descriptions, observation: Observation):
        """Action means [..., J], in units of the action scale."""
        require_inputs(descriptions, observation)
        return _mean_action(self.policy_config)(self.policy, descriptions, observation)

    def values(self, descriptions: Descriptions, observation: Observation):
        """Values [..., K] of the critic's heads."""
        require_critic(self)
        require_inputs(descriptions, observation)
        return _values(self.critic_config)(self.critic, descriptions, observation)

    @functools.cached_property
    def hash(self) -> str:
        """SHA-256 of the weights of policy and critic, hexadecimal."""
        return hash_arrays(flat_weights(self))

    @functools.cached_property
    def policy_hash(self) -> str:
        """SHA-256 of the policy's weights alone, hexadecimal."""
        return hash_arrays({k: v for k, v in flat_weights(self).items() if k.startswith("policy")})

    @property
    def states_hash(self) -> str | None:
        """SHA-256 of the state bank; None without one."""
        states = flat_states(self)
        return None if states is None else hash_arrays(states)

    @property
    def num_states(self) -> int:
        """Size M of the state bank."""
        return 0 if self.states is None else len(self.states.general)

    def __repr__(self) -> str:
        return (
            f"Agent({self.name!r}, robots={list(self.robots)}, {self.num_states} states, "
            f"hash={self.hash[:12]})"
        )


@functools.lru_cache
def _mean_action(config: PolicyConfig):
    module = Policy(config)
    return jax.jit(lambda variables, d, o: module.apply(variables, d, o)[0])


@functools.lru_cache
def _values(config: CriticConfig):
    return jax.jit(Critic(config).apply)


def require_agent(agent) -> Agent:
    """The argument; TypeError if it is not an `Agent`, for example the name of one."""
    return require_kind("agent", agent, Agent, "load it with shapebody.load_agent(...)")


def require_critic(agent: Agent) -> Agent:
    """The agent; ValueError if it has no critic."""
    if require_agent(agent).critic is None:
        raise ValueError(
            f"agent {agent.name!r} has no critic, which alone can judge designs; train one by "
            "policy evaluation: shapebody.training.critics.train_critics"
        )
    return agent


def flat_weights(agent: Agent) -> dict[str, np.ndarray]:
    """Weights of both networks as float32, by names such as "policy/params/core/layer_0/bias"."""
    networks = {"policy": agent.policy}
    if agent.critic is not None:
        networks["critic"] = agent.critic
    flat = flatten_dict(networks, sep="/")
    return {name: np.array(flat[name], np.float32, order="C") for name in sorted(flat)}


def flat_states(agent: Agent) -> dict[str, np.ndarray] | None:
    """The state bank: parts of the observations as float32, state_robots as int32; or None."""
    if agent.states is None:
        return None
    names = [f.name for f in dataclasses.fields(Observation)]
    flat = {name: np.array(getattr(agent.states, name), np.float32, order="C") for name in names}
    return flat | {"state_robots": np.array(agent.state_robots, np.int32)}


def hash_arrays(arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of named arrays, independent of their order and of the file format."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.asarray(arrays[name])
        array = array.astype(array.dtype.newbyteorder("<"), order="C", copy=False)
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
