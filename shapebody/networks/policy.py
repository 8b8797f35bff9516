"""The URMA policy and the density of its actions.

The mean of joint j's action is the dot product of its key with the output of the core network,
which sees the latent of all joints, the general observations and what is static of the design.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

from shapebody.arguments import require_kind
from shapebody.networks.config import PolicyConfig
from shapebody.networks.inputs import (
    JOINT_DESCRIPTION,
    JOINT_OBSERVATION,
    Standardized,
    join,
    require_inputs,
)
from shapebody.networks.urma import Core, PartEncoder


class Policy(Standardized):
    """The URMA policy: one Gaussian per joint, any number of joints.

    `apply(variables, descriptions, observation)` gives (mean, std), both [..., J]; actions are in
    units of the action scale. `method="embed"` and `method="act"` are the two halves of it.
    """

    config: PolicyConfig = PolicyConfig()

    def __post_init__(self):
        require_kind("config", self.config, PolicyConfig, "shapebody.PolicyConfig(...)")
        super().__post_init__()

    def setup(self):
        config = self.config
        self.declare("joint_descriptions", "static", "joint_observations", "general")
        self.joint_encoder = PartEncoder(
            JOINT_DESCRIPTION,
            JOINT_OBSERVATION,
            config.key_widths,
            config.value_latent,
            False,
            config.initial_temperature,
            config.minimum_temperature,
            config.latent_scale,
        )
        self.core = Core(config.core_widths)
        self.log_std = nn.Dense(
            1,
            kernel_init=nn.initializers.zeros,
            bias_init=nn.initializers.constant(float(np.log(config.initial_std))),
        )

    def embed(self, descriptions) -> Any:
        """What depends on the design alone: a pytree to be given to `act`."""
        joints = self.standardize("joint_descriptions", descriptions.joints)
        return {
            "joints": self.joint_encoder.embed(joints),
            "static": self.standardize("static", descriptions.static),
        }

    def act(self, embedding, descriptions, observation):
        """Action means (within +-mean_limit) and standard deviations, both [..., J].

        Padded joints get mean 0 and standard deviation 1.
        """
        mask = descriptions.joint_mask
        # Means.
        latent, keys, tanh_keys = self.joint_encoder(
            embedding["joints"],
            self.standardize("joint_observations", observation.joints),
            mask,
        )
        general = self.standardize("general", observation.general)
        core = self.core(join(latent, general, embedding["static"]))
        mean = jnp.einsum("...k,...jk->...j", core, keys)
        mean = jnp.clip(mean, -self.config.mean_limit, self.config.mean_limit)
        # Standard deviations.
        log_std = self.log_std(tanh_keys if self.config.log_std_input == "tanh" else keys)
        # The logarithm is clipped, not its exponential: an overflow would make the gradient NaN.
        low, high = np.log(self.config.std_limits)
        std = jnp.exp(jnp.clip(log_std[..., 0], low, high))
        return mean * mask, jnp.where(mask > 0, std, 1.0)

    def __call__(self, descriptions, observation):
        require_inputs(descriptions, observation, of_policy=True)
        return self.act(self.embed(descriptions), descriptions, observation)


def log_prob(mean, std, action, mask):
    """Log density of actions [..., J] under independent Gaussians, summed over the real joints."""
    error = (action - mean) / std
    per_joint = -0.5 * error * error - jnp.log(std) - 0.5 * float(np.log(2 * np.pi))
    return jnp.sum(per_joint * mask, axis=-1)


def entropy(std, mask):
    """Differential entropy in nats of the action Gaussians, summed over the real joints."""
    per_joint = jnp.log(std) + 0.5 * float(np.log(2 * np.pi * np.e))
    return jnp.sum(per_joint * mask, axis=-1)


@functools.lru_cache
def mean_action_policy(config: PolicyConfig):
    """(act, embed) of a policy without exploration noise, for rollouts of frozen policies.

    act: as `Locomotion` wants it; its parameters are what embed(variables, descriptions [N]) gives,
    so that a body is encoded once instead of in every step. One configuration has one pair, which
    belongs to one compilation.
    """
    module = Policy(config)

    def act(params, key, descriptions, observation):
        variables, embedding = params
        mean, _ = module.apply(variables, embedding, descriptions, observation, method="act")
        return mean, ()

    def embed(variables, descriptions):
        return variables, module.apply(variables, descriptions, method="embed")

    return act, jax.jit(embed)
