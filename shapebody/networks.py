"""URMA networks: the policy, the original critic and the direct-design critic (eq. 3).

A robot is a set of joints and a set of feet, each with a description d and an observation o. Every
part is encoded on its own and the parts are summed, so one network serves any number of them:

    latent = sum over parts of softmax(tanh(key(d, o)) / temperature) outer value

The value is a function of o in the policy and in the original critic, and of (d, o) in the
direct-design critic. The sum, together with the general observations, enters a core network.

As in the published policies, the key layer sees the observation as well as the description, its
output passes a tanh, and key and value meet in an outer product; eq. (3) writes the description
only, no tanh and an elementwise product. The first key layer is linear in [d, o], so `embed`
computes the part that depends on the design once, and `act` (or `value`) adds the rest for every
state of that design.

Inputs are read by attribute: descriptions need joints [..., J, 30], joint_mask [..., J],
feet [..., F, 21], foot_mask [..., F] and static [..., 14]; observations need joints [..., J, 4],
feet [..., F, 3], general [..., 13] and privileged [..., 5]. The leading axes of the two are
broadcast against each other: descriptions [B, 1, ...] with observations [B, T, ...] are encoded
B times only. Joints and feet whose mask is 0 have no influence on anything.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

from shapebody.checks import (
    refuse,
    require_array,
    require_choice,
    require_integer,
    require_key,
    require_kind,
    require_list,
    require_number,
    require_shape,
)

JOINT_DESCRIPTION = 30
FOOT_DESCRIPTION = 21
STATIC = 14
JOINT_OBSERVATION = 4
FOOT_OBSERVATION = 3
GENERAL = 13
PRIVILEGED = 5

WIDEST, MOST_LAYERS = 65_536, 100
"""Largest width of a layer, and largest number of layers."""

INPUT_SIZES = {
    "joint_descriptions": JOINT_DESCRIPTION,
    "foot_descriptions": FOOT_DESCRIPTION,
    "static": STATIC,
    "joint_observations": JOINT_OBSERVATION,
    "foot_observations": FOOT_OBSERVATION,
    "general": GENERAL,
    "privileged": PRIVILEGED,
}


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


def elu(x):
    """ELU. On a CPU about twice as fast as the form with `expm1`, exact to 1e-7."""
    return jnp.maximum(x, 0) + (jnp.exp(jnp.minimum(x, 0)) - 1)


class PartEncoder(nn.Module):
    """Encoder of one kind of part (joints or feet): keys, values and their sum (eq. 3)."""

    description_size: int
    observation_size: int
    key_widths: tuple[int, ...]
    value_latent: int
    direct_design: bool
    initial_temperature: float
    minimum_temperature: float
    latent_scale: float

    def setup(self):
        both = self.description_size + self.observation_size
        value_size = both if self.direct_design else self.observation_size
        weights, zeros = nn.initializers.lecun_normal(), nn.initializers.zeros
        width = self.key_widths[0]
        self.key_kernel = self.param("key_kernel", weights, (both, width))
        self.key_bias = self.param("key_bias", zeros, (width,))
        self.key_norm = nn.LayerNorm(epsilon=1e-6)
        self.key_layers = [nn.Dense(width) for width in self.key_widths[1:]]
        self.value_kernel = self.param("value_kernel", weights, (value_size, self.value_latent))
        self.value_bias = self.param("value_bias", zeros, (self.value_latent,))
        start = float(np.log(self.initial_temperature - self.minimum_temperature))
        self.log_temperature = self.param("log_temperature", nn.initializers.constant(start), (1,))

    def embed(self, descriptions):
        """Description-only summands of the first layers, [..., parts, width] each."""
        size = self.description_size
        embedding = {"key": descriptions @ self.key_kernel[:size] + self.key_bias}
        if self.direct_design:
            embedding["value"] = descriptions @ self.value_kernel[:size] + self.value_bias
        return embedding

    def temperature(self):
        return jnp.exp(self.log_temperature) + self.minimum_temperature

    def __call__(self, embedding, observations, mask):
        """Latent [..., L * value_latent], softmaxed keys and tanh keys [..., parts, L]."""
        size = self.description_size
        hidden = embedding["key"] + observations @ self.key_kernel[size:]
        hidden = self.key_norm(hidden)
        for layer in self.key_layers:
            hidden = layer(elu(hidden))
        # The published clip of tanh to +-(1 - 1e-8) is the identity in float32.
        tanh_keys = jnp.tanh(hidden)
        keys = nn.softmax(tanh_keys / self.temperature(), axis=-1)
        if self.direct_design:
            values = embedding["value"] + observations @ self.value_kernel[size:]
        else:
            values = observations @ self.value_kernel + self.value_bias
        values = elu(values) * (self.latent_scale * mask[..., None])
        return aggregate(keys, values), keys, tanh_keys


def aggregate(keys, values):
    """Sum over parts of the outer products of keys [..., parts, L] and values [..., parts, v].

    Returns [..., L * v], entry k * v + l holding key entry k times value entry l.
    """
    leading, latent, width = keys.shape[:-2], keys.shape[-1], values.shape[-1]
    keys = keys.reshape((-1,) + keys.shape[-2:])
    values = values.reshape((-1,) + values.shape[-2:])
    product = jax.lax.dot_general(keys, values, (((1,), (1,)), ((0,), (0,))))
    return product.reshape(leading + (latent * width,))


class WeightNormDense(nn.Module):
    """Dense layer with kernel scale * v / |v| per output (Salimans and Kingma, 2016)."""

    features: int

    @nn.compact
    def __call__(self, x):
        kernel = self.param("kernel", nn.initializers.lecun_normal(), (x.shape[-1], self.features))
        scale = self.param("scale", nn.initializers.ones, (self.features,))
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        norm = jnp.sqrt(jnp.sum(kernel * kernel, axis=0) + 1e-24)
        return x @ (kernel * (scale / norm)) + bias


class Core(nn.Module):
    """Weight-normalised layers with ELU between them and LayerNorm after the first one."""

    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, x):
        for index, width in enumerate(self.widths):
            x = WeightNormDense(width, name=f"layer_{index}")(x)
            if index == 0:
                x = nn.LayerNorm(epsilon=1e-6, name="norm")(x)
            if index + 1 < len(self.widths):
                x = elu(x)
        return x


DESCRIPTION_PARTS = {"joints": JOINT_DESCRIPTION, "feet": FOOT_DESCRIPTION, "static": STATIC}
OBSERVATION_PARTS = {
    "joints": JOINT_OBSERVATION,
    "feet": FOOT_OBSERVATION,
    "general": GENERAL,
    "privileged": PRIVILEGED,
}


def require_inputs(descriptions, observation, of_policy: bool = False) -> None:
    """TypeError if a network's inputs lack what is read of them; ValueError for wrong columns.

    of_policy: feet and privileged observations may be absent. Costs nothing in compiled code.
    """
    unread = ("feet", "privileged") if of_policy else ()
    for argument, value, parts, hint in (
        ("descriptions", descriptions, DESCRIPTION_PARTS, "describe(robot)(space(f))"),
        ("observation", observation, OBSERVATION_PARTS, "such as the states of an agent"),
    ):
        _require_parts(argument, value, {k: v for k, v in parts.items() if k not in unread}, hint)
    for name in ("joints",) if of_policy else ("joints", "feet"):
        count, other = (getattr(x, name).shape[-2] for x in (descriptions, observation))
        if count != other:
            raise ValueError(
                f"descriptions are of {count} {name} and observation is of {other}; expected the "
                "same robot and padding (`sizes`) in both"
            )


def _require_parts(argument, value, parts, hint) -> None:
    for name, columns in parts.items():
        if not hasattr(value, name):
            raise refuse(argument, value, f"an object with {name}", hint, TypeError)
        leading = ("...",) if name in ("static", "general", "privileged") else ("...", "n")
        require_shape(f"{argument}.{name}", getattr(value, name), (*leading, columns))


class _Standardized(nn.Module):
    """Declares the input constants (collection "constants", identity unless given)."""

    def standardize(self, name, value):
        size = INPUT_SIZES[name]
        if value.shape[-1] != size:
            raise ValueError(
                f"{name} has {value.shape[-1]} columns; expected {size} (last axis of the array)"
            )
        constants = self.constants[name].value
        return (value - constants["mean"]) / constants["scale"]

    def declare(self, *names):
        self.constants = {
            name: self.variable("constants", name, _identity, INPUT_SIZES[name]) for name in names
        }


def _identity(size):
    return {"mean": jnp.zeros(size), "scale": jnp.ones(size)}


class Policy(_Standardized):
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
        latent, keys, tanh_keys = self.joint_encoder(
            embedding["joints"],
            self.standardize("joint_observations", observation.joints),
            mask,
        )
        general = self.standardize("general", observation.general)
        core = self.core(_join(latent, general, embedding["static"]))
        mean = jnp.einsum("...k,...jk->...j", core, keys)
        mean = jnp.clip(mean, -self.config.mean_limit, self.config.mean_limit)
        log_std = self.log_std(tanh_keys if self.config.log_std_input == "tanh" else keys)
        # The logarithm is clipped, not its exponential: an overflow would make the gradient NaN.
        low, high = np.log(self.config.std_limits)
        std = jnp.exp(jnp.clip(log_std[..., 0], low, high))
        return mean * mask, jnp.where(mask > 0, std, 1.0)

    def __call__(self, descriptions, observation):
        require_inputs(descriptions, observation, of_policy=True)
        return self.act(self.embed(descriptions), descriptions, observation)


class Critic(_Standardized):
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
        values = self.heads(_join(joints, feet, general, embedding["static"], privileged))
        return jnp.moveaxis(values[..., 0], 0, -1)

    def act(self, embedding, descriptions, observation):
        """The same as `value`, so that policy and critic can be called alike."""
        return self.value(embedding, descriptions, observation)

    def __call__(self, descriptions, observation):
        require_inputs(descriptions, observation)
        return self.value(self.embed(descriptions), descriptions, observation)


def _join(*parts):
    """Concatenate along the last axis after broadcasting the leading ones."""
    leading = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
    return jnp.concatenate(
        [jnp.broadcast_to(part, leading + part.shape[-1:]) for part in parts], axis=-1
    )


def initialize(network, key, constants=None) -> dict:
    """Fresh variables {"params": ..., "constants": ...} of a `Policy` or a `Critic`.

    Args:
        network: the module.
        key: PRNG key.
        constants: input constants from `standardization`; the identity if not given.
    """
    require_kind("network", network, nn.Module, "shapebody.Policy(...) or shapebody.Critic(...)")
    require_key("key", key)
    if constants is not None:
        _require_constants(constants)
    descriptions = SimpleNamespace(
        joints=jnp.zeros((1, JOINT_DESCRIPTION)),
        joint_mask=jnp.ones(1),
        feet=jnp.zeros((1, FOOT_DESCRIPTION)),
        foot_mask=jnp.ones(1),
        static=jnp.zeros(STATIC),
    )
    observation = SimpleNamespace(
        joints=jnp.zeros((1, JOINT_OBSERVATION)),
        feet=jnp.zeros((1, FOOT_OBSERVATION)),
        general=jnp.zeros(GENERAL),
        privileged=jnp.zeros(PRIVILEGED),
    )
    # One compiled program: op by op, the first call would take four times as long.
    variables = jax.jit(lambda key: network.init(key, descriptions, observation))(key)
    if constants is None:
        return dict(variables)
    used = {name: constants[name] for name in variables["constants"]}
    return {"params": variables["params"], "constants": used}


def _require_constants(constants) -> None:
    """TypeError or ValueError if input constants are not as `standardization` returns them."""
    require_kind("constants", constants, Mapping, "what networks.standardization returns")
    for name, size in INPUT_SIZES.items():
        one = constants.get(name)
        if not isinstance(one, Mapping) or one.keys() != {"mean", "scale"}:
            raise refuse(f"constants[{name!r}]", one, 'a dictionary of "mean" and "scale"')
        for part in ("mean", "scale"):
            require_shape(f"constants[{name!r}][{part!r}]", one[part], (size,))


# Typical size of an observation in the units of the environment: 0.5 rad and 5 rad/s of a joint,
# 1 rad/s and 1 m/s of the trunk, half a metre of height, half a second of foot contact.
OBSERVATION_CONSTANTS = {
    "joint_observations": ([0.0] * 4, [0.5 / 6.5, 5 / 180, 1 / 10, 1.0]),
    "foot_observations": ([0.0, -0.8, -0.8], [1.0, 0.2, 0.2]),
    "general": ([0.0] * 13, [1 / 50] * 3 + [1.0] * 10),
    "privileged": ([0.0, 0.0, 0.0, -0.9, 0.0], [1 / 10] * 3 + [1 / 10, 1.0]),
}


def standardization(*descriptions, floor=1e-3, constant=1e-6) -> dict:
    """Input constants: descriptions to zero mean and unit deviation, observations to fixed scales.

    The paper's divisors fit 50 robots; over the designs of one robot they leave some columns with
    differences of 0.002, which a small network learns slowly.

    Args:
        descriptions: one or more `Descriptions`, each with any leading batch axes, drawn from the
            designs to be trained on. Padded joints and feet are left out.
        floor: lowest divisor, so that a column that hardly differs is not blown up.
        constant: a column whose deviation is below this is centred only (divisor 1).

    Returns:
        {name: {"mean": f32[n], "scale": f32[n]}} for all network inputs; an input enters a network
        as (input - mean) / scale. Put it into the collection "constants" or give it to
        `initialize`.

    Raises:
        ValueError: if no descriptions are given.
    """
    if not descriptions:
        raise ValueError("standardization got no descriptions; give at least one batch of them")
    require_number("floor", floor, above=0)
    require_number("constant", constant, 0)
    for batch in descriptions:
        hint = "describe(robot)(space(designs))"
        _require_parts("descriptions", batch, DESCRIPTION_PARTS, hint)

    def rows(name, mask=None):
        tables = []
        for batch in descriptions:
            table = np.asarray(getattr(batch, name), np.float64)
            table = table.reshape(-1, table.shape[-1])
            if mask is not None:
                table = table[np.asarray(getattr(batch, mask)).reshape(-1) > 0]
            tables.append(table)
        return np.concatenate(tables)

    def of(table):
        deviation = table.std(axis=0)
        scale = np.where(deviation < constant, 1.0, np.maximum(deviation, floor))
        return table.mean(axis=0), scale

    constants = {
        "joint_descriptions": of(rows("joints", "joint_mask")),
        "foot_descriptions": of(rows("feet", "foot_mask")),
        "static": of(rows("static")),
        **OBSERVATION_CONSTANTS,
    }
    return {
        name: {"mean": jnp.asarray(mean, jnp.float32), "scale": jnp.asarray(scale, jnp.float32)}
        for name, (mean, scale) in constants.items()
    }


def count_parameters(params) -> int:
    """Number of learned scalars in a params collection (constants do not belong to it)."""
    leaves = jax.tree.leaves(params)
    if not leaves or not all(hasattr(leaf, "shape") for leaf in leaves):
        raise refuse("params", params, 'a pytree of arrays, such as agent.policy["params"]')
    return sum(int(np.prod(leaf.shape)) for leaf in leaves)


def log_prob(mean, std, action, mask):
    """Log density of actions [..., J] under independent Gaussians, summed over the real joints."""
    error = (action - mean) / std
    per_joint = -0.5 * error * error - jnp.log(std) - 0.5 * float(np.log(2 * np.pi))
    return jnp.sum(per_joint * mask, axis=-1)


def entropy(std, mask):
    """Differential entropy in nats of the action Gaussians, summed over the real joints."""
    per_joint = jnp.log(std) + 0.5 * float(np.log(2 * np.pi * np.e))
    return jnp.sum(per_joint * mask, axis=-1)
