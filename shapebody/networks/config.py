"""Sizes of the policy and of the critic."""

from dataclasses import dataclass

from shapebody.arguments import (
    require_array,
    require_choice,
    require_integer,
    require_list,
    require_number,
)

WIDEST, MOST_LAYERS = 65_536, 100
"""Largest width of a layer, and largest number of layers."""


@dataclass(frozen=True)
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

    key_widths: tuple[int, ...] = (256, 256)
    value_latent: int = 4
    core_widths: tuple[int, ...] = (512, 256, 256, 256, 256)
    initial_temperature: float = 1.0
    minimum_temperature: float = 0.025
    latent_scale: float = 1.0
    initial_std: float = 1.0
    log_std_input: str = "tanh"
    mean_limit: float = 10.0
    std_limits: tuple[float, float] = (0.01, 2.0)

    def __post_init__(self):
        _set_widths(self, "key_widths", "core_widths")
        _check_encoder(self, "value_latent")
        limits = require_array("std_limits", self.std_limits, (2,)).astype(float)
        object.__setattr__(self, "std_limits", tuple(limits.tolist()))
        require_number("initial_std", self.initial_std, above=0)
        require_number("mean_limit", self.mean_limit, above=0)
        if self.core_widths[-1] != self.key_widths[-1]:
            raise ValueError(
                f"core_widths ends with {self.core_widths[-1]} and key_widths with "
                f"{self.key_widths[-1]}; make the last widths equal, an action mean is their dot "
                "product"
            )
        require_choice("log_std_input", self.log_std_input, ("tanh", "softmax"))
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


@dataclass(frozen=True)
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

    kind: str = "direct-design"
    heads: int = 3
    joint_key_widths: tuple[int, ...] = (64, 64)
    joint_value_latent: int = 32
    foot_key_widths: tuple[int, ...] = (32, 32)
    foot_value_latent: int = 32
    head_widths: tuple[int, ...] = (512, 256, 128, 128, 128)
    initial_temperature: float = 1.0
    minimum_temperature: float = 0.025
    latent_scale: float = 1.0

    def __post_init__(self):
        _set_widths(self, "joint_key_widths", "foot_key_widths", "head_widths")
        _check_encoder(self, "joint_value_latent", "foot_value_latent", "heads")
        require_choice("kind", self.kind, ("direct-design", "original"))

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


def _set_widths(config, *names):
    """Turn the named fields into tuples of int, so that a config read from JSON stays hashable."""
    for name in names:
        widths = require_list(name, getattr(config, name), MOST_LAYERS)
        widths = tuple(require_integer(f"a width in {name}", x, 1, WIDEST) for x in widths)
        if not widths:
            raise ValueError(f"{name} is {widths}; expected at least one width, all positive")
        object.__setattr__(config, name, widths)


def _check_encoder(config, *positive):
    for name in positive:
        require_integer(name, getattr(config, name), 1, WIDEST)
    for name in ("initial_temperature", "minimum_temperature", "latent_scale"):
        require_number(name, getattr(config, name))
    if not 0 <= config.minimum_temperature < config.initial_temperature:
        raise ValueError(
            f"initial_temperature is {config.initial_temperature}; choose it above "
            f"minimum_temperature {config.minimum_temperature}"
        )
    if not config.latent_scale > 0:
        raise ValueError(f"latent_scale is {config.latent_scale}; expected a positive number")
