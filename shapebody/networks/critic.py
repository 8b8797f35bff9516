"""The critics: original and direct-design (eq. 3).

Joints and feet are encoded like the joints of the policy. Every head is a core network of its own
over both latents, all observations of the whole robot and what is static of the design.
"""

from typing import Any

import jax.numpy as jnp
from flax import linen as nn

from shapebody.arguments import require_kind
from shapebody.networks.config import CriticConfig
from shapebody.networks.inputs import (
    FOOT_DESCRIPTION,
    FOOT_OBSERVATION,
    INPUT_SIZES,
    JOINT_DESCRIPTION,
    JOINT_OBSERVATION,
    Standardized,
    join,
    require_inputs,
)
from shapebody.networks.urma import Core, PartEncoder


class Critic(Standardized):
    """A URMA critic: K state values from joints, feet and general observations.

    `apply(variables, descriptions, observation)` gives values [..., K], differentiable with
    respect to the descriptions. `method="embed"` and `method="value"` are the two halves of it.
    """

    config: CriticConfig = CriticConfig()

    def __post_init__(self):
        require_kind("config", self.config, CriticConfig, "shapebody.CriticConfig(...)")
        super().__post_init__()

    def setup(self):
        config = self.config
        self.declare(*INPUT_SIZES)
        direct = config.kind == "direct-design"
        shared = (config.initial_temperature, config.minimum_temperature, config.latent_scale)
        self.joint_encoder = PartEncoder(
            JOINT_DESCRIPTION,
            JOINT_OBSERVATION,
            config.joint_key_widths,
            config.joint_value_latent,
            direct,
            *shared,
        )
        self.foot_encoder = PartEncoder(
            FOOT_DESCRIPTION,
            FOOT_OBSERVATION,
            config.foot_key_widths,
            config.foot_value_latent,
            direct,
            *shared,
        )
        heads = nn.vmap(
            Core,
            in_axes=None,
            out_axes=0,
            axis_size=config.heads,
            variable_axes={"params": 0},
            split_rngs={"params": True},
        )
        self.heads = heads(config.head_widths + (1,))

    def embed(self, descriptions) -> Any:
        """What depends on the design alone: a pytree to be given to `value`."""
        joints = self.standardize("joint_descriptions", descriptions.joints)
        feet = self.standardize("foot_descriptions", descriptions.feet)
        return {
            "joints": self.joint_encoder.embed(joints),
            "feet": self.foot_encoder.embed(feet),
            "static": self.standardize("static", descriptions.static),
        }

    def value(self, embedding, descriptions, observation):
        """Values of the K heads, [..., K]: discounted returns of the state."""
        joints, _, _ = self.joint_encoder(
            embedding["joints"],
            self.standardize("joint_observations", observation.joints),
            descriptions.joint_mask,
        )
        feet, _, _ = self.foot_encoder(
            embedding["feet"],
            self.standardize("foot_observations", observation.feet),
            descriptions.foot_mask,
        )
        general = self.standardize("general", observation.general)
        privileged = self.standardize("privileged", observation.privileged)
        values = self.heads(join(joints, feet, general, embedding["static"], privileged))
        return jnp.moveaxis(values[..., 0], 0, -1)

    def act(self, embedding, descriptions, observation):
        """The same as `value`, so that policy and critic can be called alike."""
        return self.value(embedding, descriptions, observation)

    def __call__(self, descriptions, observation):
        require_inputs(descriptions, observation)
        return self.value(self.embed(descriptions), descriptions, observation)
