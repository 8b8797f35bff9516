"""What enters the networks: sizes of the inputs, checks, standardization, first variables.

Inputs are read by attribute: descriptions need joints [..., J, 30], joint_mask [..., J],
feet [..., F, 21], foot_mask [..., F] and static [..., 14]; observations need joints [..., J, 4],
feet [..., F, 3], general [..., 13] and privileged [..., 5]. The leading axes of the two are
broadcast against each other: descriptions [B, 1, ...] with observations [B, T, ...] are encoded
B times only. Joints and feet whose mask is 0 are padding, which has no influence on anything.
"""

from collections.abc import Mapping
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

from shapebody.arguments import refuse, require_key, require_kind, require_number, require_shape

# Numbers of columns. What they are is said by `design.descriptions` and `task.observations`.
JOINT_DESCRIPTION = 30
FOOT_DESCRIPTION = 21
STATIC = 14
JOINT_OBSERVATION = 4
FOOT_OBSERVATION = 3
GENERAL = 13
PRIVILEGED = 5

INPUT_SIZES = {
    "joint_descriptions": JOINT_DESCRIPTION,
    "foot_descriptions": FOOT_DESCRIPTION,
    "static": STATIC,
    "joint_observations": JOINT_OBSERVATION,
    "foot_observations": FOOT_OBSERVATION,
    "general": GENERAL,
    "privileged": PRIVILEGED,
}

DESCRIPTION_PARTS = {"joints": JOINT_DESCRIPTION, "feet": FOOT_DESCRIPTION, "static": STATIC}

OBSERVATION_PARTS = {
    "joints": JOINT_OBSERVATION,
    "feet": FOOT_OBSERVATION,
    "general": GENERAL,
    "privileged": PRIVILEGED,
}


def require_inputs(descriptions, observation, of_policy: bool = False) -> None:
    """TypeError if a part of a network's inputs is missing; ValueError for wrong columns.

    of_policy: feet and privileged observations may be missing. Costs nothing in compiled code.
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


class Standardized(nn.Module):
    """A network that standardizes its inputs by constants, the collection "constants"."""

    def declare(self, *names):
        """Declare the constants of these inputs; they are the identity unless given."""
        self.constants = {
            name: self.variable("constants", name, identity, INPUT_SIZES[name]) for name in names
        }

    def standardize(self, name, value):
        """An input [..., n] as (input - mean) / scale."""
        size = INPUT_SIZES[name]
        if value.shape[-1] != size:
            raise ValueError(
                f"{name} has {value.shape[-1]} columns; expected {size} (last axis of the array)"
            )
        constants = self.constants[name].value
        return (value - constants["mean"]) / constants["scale"]


def identity(size: int) -> dict:
    """Constants that leave an input of `size` columns as it is."""
    return {"mean": jnp.zeros(size), "scale": jnp.ones(size)}


def join(*parts):
    """Concatenate arrays along the last axis after broadcasting the leading ones."""
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
    require_kind("constants", constants, Mapping, "inputs.standardization(descriptions)")
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

    Not in the paper, whose divisors fit 50 robots. Over the designs of one robot they leave some
    columns with differences of 0.002, which a small network learns slowly.

    Args:
        descriptions: one or more `Descriptions`, each with any leading batch axes, drawn from the
            designs of the training. Padded joints and feet are left out.
        floor: lowest divisor > 0, so that a column that hardly differs does not become large.
        constant: a column whose deviation is below this (>= 0) is only centred (divisor 1).

    Returns:
        {name: {"mean": f32[n], "scale": f32[n]}} for all network inputs; an input enters a network
        as (input - mean) / scale. Put it into the collection "constants" or give it to
        `initialize`.

    Raises:
        ValueError: if no descriptions are given.
    """
    if not descriptions:
        raise ValueError("descriptions are missing; expected at least one batch of them")
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
