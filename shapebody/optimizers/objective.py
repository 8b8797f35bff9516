"""The design objective (eq. 5): mean value over the state bank minus the trust-region penalty."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from shapebody.agent.agent import Agent, require_critic
from shapebody.arguments import require_integer, require_key, require_kind, require_number
from shapebody.design.descriptions import Descriptions, describe
from shapebody.design.space import DesignSpace
from shapebody.networks.config import CriticConfig
from shapebody.networks.critic import Critic
from shapebody.optimizers.state_bank import bank, trim
from shapebody.robot.robot import Robot, require_robot
from shapebody.task.observations import Observation

LARGEST_LAMBDA = 1e30
"""Penalties of larger coefficients would be too large for single precision."""

MAX_ROWS = 8192
"""Most (design, state) pairs that the critic sees at once, but at least one state per design."""


@dataclass(frozen=True, eq=False)
class DesignCritic:
    """The critic of one robot as a function of the design, in two steps: V(s, Φ(f)).

    `descriptions(designs)` applies Φ and describes the bodies; calling the instance gives their
    values. A search does the first once per design and the second on every slice of the states.
    Instances are shared (`design_critic`), so that what was compiled for one is compiled for all
    searches on that robot with a critic of that size.
    """

    space: DesignSpace
    describe: Callable
    critic: Critic

    def descriptions(self, designs) -> Descriptions:
        """Descriptions of designs [S, d]."""
        return self.describe(self.space(designs))

    def __call__(self, variables, descriptions: Descriptions, states: Observation):
        """Values [S, B, K] of S described designs in B states."""
        descriptions = jax.tree.map(lambda x: x[:, None], descriptions)
        return self.critic.apply(variables, descriptions, states)


_critics: dict[Any, DesignCritic] = {}


def design_critic(robot: Robot, config: CriticConfig) -> DesignCritic:
    """The `DesignCritic` of a robot and a critic's configuration, built once."""
    require_robot(robot)
    require_kind("config", config, CriticConfig, "shapebody.CriticConfig(...)")
    key = (robot.path, robot.xml, config)
    if key not in _critics:
        # The robot's own sizes, without padding: it has no influence and costs time.
        _critics[key] = DesignCritic(DesignSpace(robot), describe(robot), Critic(config))
    return _critics[key]


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Objective:
    r"""Ĵ_λ(f) = 1/M Σ_m V̄(s_m, Φ(f)) - λ |f - f_ref|² / d (eq. 5), to be maximized.

    V̄ is the mean over the critic's heads. The states s_m give what changes while walking (joint
    and foot observations, velocities, commands); everything that describes the body comes from
    Φ(f). A pytree: it can be an argument of jitted functions, and another λ, reference, critic or
    seed needs no new compilation.
    """

    critic_variables: Any
    """Variables of the critic."""
    states: Observation
    """The state bank, with leading axis M."""
    reference: jax.Array
    """f_ref, float32 [d]: from which the penalty measures. Not the `Reference` of Φ, a robot's."""
    free: jax.Array
    """Which entries of f count, bool [d]; the others are held at f_ref."""
    trust_region: jax.Array
    """λ, float32 []: weight of the penalty, not a radius."""
    design_critic: DesignCritic = field(metadata=dict(static=True))
    """The critic as a function of designs and states."""
    batch_size: int = field(default=64, metadata=dict(static=True))
    """States per minibatch."""

    @classmethod
    def of(
        cls,
        agent: Agent,
        robot: Robot,
        trust_region: float = 100.0,
        reference=None,
        states: Observation | None = None,
        batch_size: int = 64,
        frozen: tuple[str, ...] = (),
    ) -> Objective:
        """The objective of an agent for a robot.

        Args:
            agent: frozen agent whose critic is asked.
            robot: the robot to be designed.
            trust_region: penalty coefficient λ >= 0.
            reference: f_ref [d] in [-1, 1]; the robot as it is (f = 0) if not given.
            states: state bank to use; `bank(agent, robot)` if not given.
            batch_size: states per minibatch.
            frozen: parameters that are held at f_ref, see `DesignSpace.frozen`.

        Raises:
            TypeError: if `agent` is not an `Agent` or `robot` is not a `Robot`, but a name.
            ValueError: for a λ that is negative or not finite, a wrong reference or batch size,
                unknown names of parameters, and an agent without a critic, or without states that
                fit the robot.
        """
        require_critic(agent)
        hint = "the penalty coefficient, 100 in the paper"
        require_number("trust_region", trust_region, 0, LARGEST_LAMBDA, hint=hint)
        require_integer("batch_size", batch_size, 1)
        require_robot(robot)
        critic = design_critic(robot, agent.critic_config)
        space = critic.space
        reference = space.reference if reference is None else space.validate(reference)
        if reference.ndim != 1:
            raise ValueError(
                f"reference has shape {reference.shape}; expected one design [{space.dim}]"
            )
        states = bank(agent, robot) if states is None else trim(states, robot)
        return cls(
            critic_variables=jax.tree.map(jnp.asarray, agent.critic),
            states=jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), states),
            reference=jnp.asarray(reference),
            free=jnp.asarray(~space.frozen(frozen)),
            trust_region=jnp.asarray(trust_region, jnp.float32),
            design_critic=critic,
            batch_size=int(batch_size),
        )

    @property
    def dim(self) -> int:
        """Length d of a design."""
        return self.reference.shape[-1]

    @property
    def num_states(self) -> int:
        """Size M of the state bank."""
        return self.states.general.shape[0]

    def hold(self, designs):
        """Designs [..., d] with the frozen entries at f_ref."""
        return jnp.where(
            self.free, self.design_critic.space.as_float32(designs, jnp), self.reference
        )

    def batch(self, key) -> Observation:
        """A minibatch of states, drawn without replacement; the whole bank if it is smaller."""
        require_key("key", key)
        if self.num_states <= self.batch_size:
            return self.states
        chosen = jax.random.choice(key, self.num_states, (self.batch_size,), replace=False)
        return jax.tree.map(lambda x: x[chosen], self.states)

    def value(self, designs, states: Observation | None = None):
        """Mean of V̄ over `states` (the whole bank if not given) for designs [..., d] -> [...]."""
        designs = self.hold(designs)
        states = self.states if states is None else trim(states, self.design_critic.space.robot)
        rows = designs.reshape(-1, designs.shape[-1])
        return mean_value(self, rows, states).reshape(designs.shape[:-1])

    def penalty(self, designs):
        """λ |f - f_ref|² / d for designs [..., d] -> [...]."""
        difference = self.hold(designs) - self.reference
        return self.trust_region * jnp.sum(difference**2, -1) / self.dim

    def __call__(self, designs, states: Observation | None = None):
        """Ĵ_λ of designs [..., d] -> [...], on `states` or the whole bank.

        A value that is not finite counts as the worst, -inf.
        """
        total = self.value(designs, states) - self.penalty(designs)
        return jnp.where(jnp.isfinite(total), total, -jnp.inf)


@jax.jit
def mean_value(objective: Objective, designs, states: Observation):
    """Mean value [S] of designs [S, d] over states and heads, in slices of the states."""
    critic = objective.design_critic
    descriptions = critic.descriptions(designs)
    count = states.general.shape[0]
    size = min(count, max(1, MAX_ROWS // len(designs)))
    if size == count:
        values = critic(objective.critic_variables, descriptions, states)
        return jnp.mean(values, axis=(-2, -1))
    slices = -(-count // size)
    index = np.arange(slices * size)
    parts = jax.tree.map(lambda x: x[(index % count).reshape(slices, size)], states)
    weight = jnp.asarray((index < count).reshape(slices, size), jnp.float32)

    def total(part):
        states, weight = part
        values = critic(objective.critic_variables, descriptions, states)
        return jnp.sum(jnp.mean(values, axis=-1) * weight, axis=-1)

    return jnp.sum(jax.lax.map(total, (parts, weight)), axis=0) / count
