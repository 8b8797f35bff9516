"""Sizes of the policy and of the critic."""

from typing import Literal

from shapebody.configuration import NonNegative, Pair, Positive, configuration, integer, sequence

WIDEST, MOST_LAYERS = 65_536, 100
"""Largest width of a layer, and largest number of layers."""

Width = integer(1, WIDEST)
Widths = sequence(
    Width, f"widths of layers, at least one, each from 1 to {WIDEST:,}", 1, MOST_LAYERS
)


@configuration
class PolicyConfig:
    """Sizes of the URMA policy. The defaults are the paper's: 945,430 parameters.

    Raises:
        ValueError: if the widths do not fit together or a value is out of range.
    """

    key_widths: Widths = (256, 256)
    """Widths of the layers that make a joint's key of its description and observation. The last
    one is the length L of the key. The softmax runs over the entries of one joint's key, not over
    joints."""
    value_latent: Width = 4
    """Length v of a joint's value. The outer product of key and value, summed over joints, is the
    latent of L v numbers that enters the core."""
    core_widths: Widths = (512, 256, 256, 256, 256)
    """Widths of the core network. The last one must equal the last key width, because an action
    mean is the dot product of the two."""
    initial_temperature: Positive = 1.0
    """Start of the learned softmax temperature. Keys are bounded by tanh, so at 1.0 no entry of a
    softmaxed key can exceed 7.4 times another: all joints start with nearly the same key, and the
    sum can hardly tell them apart. 0.2 is a better start for short training; the authors' published
    Go2 policy ended at 0.1."""
    minimum_temperature: NonNegative = 0.025
    """Lower bound of the temperature."""
    latent_scale: Positive = 1.0
    """Factor on the summed latent before it enters the core; the paper has none (1.0). A latent
    that is scaled up drowns the command, which enters the core beside it; some shipped agents were
    trained with 8.0."""
    initial_std: Positive = 1.0
    """Standard deviation of all actions before training."""
    log_std_input: Literal["tanh", "softmax"] = "tanh"
    """What gives the standard deviation: the key before the softmax, or after it."""
    mean_limit: Positive = 10.0
    """Action means are clipped to ±mean_limit."""
    std_limits: Pair = (0.01, 2.0)
    """Lowest and highest standard deviation."""

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

    Raises:
        ValueError: if a value is out of range.
    """

    kind: Literal["direct-design", "original"] = "direct-design"
    """Whether values are made of descriptions and observations, or of observations only."""
    heads: Width = 3
    """Number K of value heads on the shared encoders."""
    joint_key_widths: Widths = (64, 64)
    """Widths of the layers that make a joint's key, see `PolicyConfig`."""
    joint_value_latent: Width = 32
    """Length of a joint's value, see `PolicyConfig`."""
    foot_key_widths: Widths = (32, 32)
    """The same for feet."""
    foot_value_latent: Width = 32
    """The same for feet."""
    head_widths: Widths = (512, 256, 128, 128, 128)
    """Hidden widths of every head; the output layer of width 1 follows."""
    initial_temperature: Positive = 1.0
    """Start of the learned softmax temperature, see `PolicyConfig`."""
    minimum_temperature: NonNegative = 0.025
    """Lower bound of the temperature."""
    latent_scale: Positive = 1.0
    """Factor on the summed latents, see `PolicyConfig`."""

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
