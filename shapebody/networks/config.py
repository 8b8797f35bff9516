"""Sizes of the policy and of the critic."""

from typing import Literal

from shapebody.configuration import (
    NonNegative,
    Pair,
    Positive,
    configuration,
    integer,
    sequence,
)

WIDEST, MOST_LAYERS = 65_536, 100
"""Largest width of a layer, and largest number of layers."""
Width = integer(1, WIDEST)
Widths = sequence(
    Width, f"widths of layers, at least one, each from 1 to {WIDEST:,}", 1, MOST_LAYERS
)


@configuration
class PolicyConfig:
    """Sizes of the URMA policy. The defaults are the paper's: 945,430 parameters.

    Attributes:
        key_widths: widths of the layers that make a joint's key; the last one is the latent
            dimension L over which the softmax runs.
        value_latent: width of a joint's value.
        core_widths: widths of the core network. The last one must equal the last key width,
            because an action mean is the dot product of the two.
        initial_temperature: start of the learned softmax temperature. Keys are bounded by tanh, so
            at 1.0 no entry of a softmaxed key can exceed 7.4 times another: all joints start with
            nearly the same key and the sum can hardly tell them apart. 0.2 is a better start for
            short training; the authors' published Go2 policy ended at 0.1.
        minimum_temperature: lower bound of the temperature.
        latent_scale: factor on the summed latent, which enters the core beside the general
            observations; the paper has none (1.0). Action means are not scaled. A softmaxed key
            has entries of about 1/L, so 8.0 makes both inputs of the core equally large, but it
            also enlarges the joints' exploration noise, which then hides command and gait clock
            from the core. Agents trained before 1.0 became the default keep their 8.0.
        initial_std: standard deviation of all actions before training.
        log_std_input: "tanh" (the key before the softmax) or "softmax" (the key after it).
        mean_limit: action means are clipped to +-mean_limit.
        std_limits: lowest and highest standard deviation.

    Raises:
        ValueError: if the widths do not fit together or a value is out of range.
    """

    key_widths: Widths = (256, 256)
    value_latent: Width = 4
    core_widths: Widths = (512, 256, 256, 256, 256)
    initial_temperature: Positive = 1.0
    minimum_temperature: NonNegative = 0.025
    latent_scale: Positive = 1.0
    initial_std: Positive = 1.0
    log_std_input: Literal["tanh", "softmax"] = "tanh"
    mean_limit: Positive = 10.0
    std_limits: Pair = (0.01, 2.0)

    def __post_init__(self):
        _check_temperatures(self)
        if self.core_widths[-1] != self.key_widths[-1]:
            raise ValueError(
                f"core_widths ends with {self.core_widths[-1]} and key_widths with "
                f"{self.key_widths[-1]}; make the last widths equal, an action mean is their dot "
                "product"
            )
        if not 0 < self.std_limits[0] <= self.initial_std <= self.std_limits[1]:
            raise ValueError(
                f"initial_std is {self.initial_std}; choose it inside std_limits {self.std_limits}"
            )

    @classmethod
    def reduced(cls, **changes) -> "PolicyConfig":
        """The small policy for two CPU cores; keyword arguments replace single fields."""
        sizes = dict(
            key_widths=(32, 32),
            core_widths=(160, 96, 32),
            initial_temperature=0.2,
        )
        return cls(**(sizes | changes))


@configuration
class CriticConfig:
    """Sizes of a URMA critic. The defaults are the paper's direct-design critic: 5,378,312
    parameters.

    Attributes:
        kind: "direct-design" (values see descriptions and observations) or "original" (values see
            observations only).
        heads: number K of value heads on the shared encoders.
        joint_key_widths, foot_key_widths: widths of the key layers; the last is the latent
            dimension of the softmax.
        joint_value_latent, foot_value_latent: width of a part's value.
        head_widths: hidden widths of every head; the output layer of width 1 follows.
        initial_temperature, minimum_temperature, latent_scale: see `PolicyConfig`. A direct-design
            critic's latent is large at 1.0 already, because its values are made of descriptions.

    Raises:
        ValueError: if a value is out of range.
    """

    kind: Literal["direct-design", "original"] = "direct-design"
    heads: Width = 3
    joint_key_widths: Widths = (64, 64)
    joint_value_latent: Width = 32
    foot_key_widths: Widths = (32, 32)
    foot_value_latent: Width = 32
    head_widths: Widths = (512, 256, 128, 128, 128)
    initial_temperature: Positive = 1.0
    minimum_temperature: NonNegative = 0.025
    latent_scale: Positive = 1.0

    def __post_init__(self):
        _check_temperatures(self)

    @classmethod
    def original(cls, **changes) -> "CriticConfig":
        """The critic without the direct path from design to value."""
        sizes = dict(kind="original", heads=1, joint_value_latent=4, foot_value_latent=4)
        return cls(**(sizes | changes))

    @classmethod
    def reduced(cls, **changes) -> "CriticConfig":
        """The small critic for two CPU cores; keyword arguments replace single fields."""
        sizes = dict(
            heads=2,
            joint_key_widths=(32, 32),
            joint_value_latent=8,
            foot_key_widths=(16, 16),
            foot_value_latent=4,
            head_widths=(80, 64),
            initial_temperature=0.2,
        )
        return cls(**(sizes | changes))

    @classmethod
    def sharp(cls, **changes) -> "CriticConfig":
        """The critic for policy evaluation on two CPU cores: the paper's three heads and value
        latent of 32, which its ablation found to matter, with small widths otherwise."""
        sizes = dict(heads=3, joint_value_latent=32, foot_value_latent=8, head_widths=(96, 64))
        return cls.reduced(**(sizes | changes))


def _check_temperatures(config):
    if not config.minimum_temperature < config.initial_temperature:
        raise ValueError(
            f"initial_temperature is {config.initial_temperature}; choose it above "
            f"minimum_temperature {config.minimum_temperature}"
        )
