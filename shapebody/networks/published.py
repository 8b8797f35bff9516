"""The published policies of the paper's authors, read from their website's weight format.

A policy is a pair of files, `<robot>.weights.json` and `<robot>.weights.bin`. The JSON file lists
the layers (name, shape, byte offset, size in bytes) and a few hyperparameters; the other file holds
the numbers, little-endian float32. The files are not part of this package.
"""

import math

import numpy as np

from shapebody.arguments import require_name, require_path, shown
from shapebody.networks.config import PolicyConfig
from shapebody.networks.inputs import (
    GENERAL,
    INPUT_SIZES,
    JOINT_DESCRIPTION,
    JOINT_OBSERVATION,
    STATIC,
    identity,
)
from shapebody.networks.policy import Policy
from shapebody.stored import read_json

# Dense_0, Dense_1: key; Dense_2: value; Dense_3 to Dense_7: core; Dense_8: log-std.
_CORE_LAYERS = 5
_LAYERS = {f"Dense_{index}" for index in range(_CORE_LAYERS + 4)} | {"LayerNorm_0", "LayerNorm_1"}


def read_published_policy(folder, name=None):
    """Read one of the authors' policies as a `Policy` of this package.

    Inputs need no standardization: descriptions and observations have the authors' divisors.
    The published core kernels are products of direction and length (WeightNorm merged); here they
    become the direction parameters and their column norms the lengths, which is the same function.

    Args:
        folder: directory with the two files.
        name: robot name, the part of the file names before `.weights`; not needed if the folder
            holds one policy only.

    Returns:
        (policy, variables, name): `policy.apply(variables, descriptions, observation)` gives
        (mean, std).

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if the name is needed, or if the files do not describe such a policy.
    """
    folder = require_path("folder", folder)
    if name is not None:
        require_name("name", name)
    else:
        found = sorted(path.name.split(".")[0] for path in folder.glob("*.weights.json"))
        if not found:
            raise FileNotFoundError(
                f"no *.weights.json in {folder}; give the folder that holds the published files"
            )
        if len(found) > 1:
            raise ValueError(f"{folder} holds policies of {', '.join(found)}; give one as name")
        name = found[0]
    index_file, numbers_file = (folder / f"{name}.weights.{end}" for end in ("json", "bin"))
    for path in (index_file, numbers_file):
        if not path.is_file():
            raise FileNotFoundError(f"{path} is missing; a published policy needs both its files")
    index = read_json(index_file, "fetch both files again")
    weights = _read_layers(_layers_of(index, index_file), numbers_file)
    config = _config(weights, _hyperparameters(index, index_file), index_file)
    variables = {"params": _params(weights), "constants": _identity_constants()}
    return Policy(config), variables, name


def _hyperparameters(index, index_file) -> dict[str, float]:
    """The policy's numbers by name; ValueError if they are none."""
    found = index.get("hyperparams", {})
    for name in ("softmax_temperature", "softmax_temperature_min", "policy_mean_abs_clip"):
        value = found.get(name, 1.0) if isinstance(found, dict) else str(found)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(
                f"{name} in {index_file} is {shown(value)}; expected a number: fetch both files "
                "again"
            )
    return found


def _layers_of(index, index_file) -> list[tuple[str, tuple[int, ...], int, int]]:
    """(name, shape, offset, size in bytes) of every layer; ValueError for another format."""
    kinds = {"name": str, "shape": list, "offset": int, "size_bytes": int}
    layers = index.get("layers") if isinstance(index, dict) else None
    found = []
    for layer in layers if isinstance(layers, list) else [None]:
        values = [layer.get(key) for key in kinds] if isinstance(layer, dict) else []
        fits = values and all(map(isinstance, values, kinds.values()))
        if not fits or not all(isinstance(n, int) and n > 0 for n in values[1]):
            raise ValueError(
                f"{index_file} is no published policy: {shown(layer)} among its layers; expected "
                'a list "layers" of name, shape, offset and size_bytes: fetch both files again'
            )
        found.append((values[0], tuple(values[1]), values[2], values[3]))
    return found


def _read_layers(layers, numbers_file):
    numbers = numbers_file.read_bytes()
    weights = {}
    for name, shape, start, size in layers:
        if size != 4 * math.prod(shape) or start < 0 or start + size > len(numbers):
            raise ValueError(
                f"{name} of shape {shape} should be {size} bytes from byte {start} of "
                f"{numbers_file}, which has {len(numbers)} bytes; fetch both files again"
            )
        array = np.frombuffer(numbers, "<f4", size // 4, start).reshape(shape)
        if not np.isfinite(array).all():
            raise ValueError(f"{name} in {numbers_file} is not finite; fetch the file again")
        weights[name] = array
    return weights


def _config(weights, hyperparameters, index_file):
    """The widths follow from the shapes; every layer must fit the one before it."""
    expected = {f"{layer}.bias" for layer in _LAYERS} | {"joint_log_softmax_temperature"}
    expected |= {f"{x}.scale" if x.startswith("Layer") else f"{x}.kernel" for x in _LAYERS}
    if expected != set(weights):
        wrong = ", ".join(sorted(expected ^ set(weights)))
        raise ValueError(f"{index_file} has other layers than the published policies: {wrong}")

    def width(layer, inputs):
        kernel = weights[f"Dense_{layer}.kernel"]
        if kernel.ndim != 2 or kernel.shape[0] != inputs:
            raise ValueError(
                f"Dense_{layer}.kernel in {index_file} has shape {kernel.shape}; expected "
                f"{inputs} rows"
            )
        return kernel.shape[1]

    first = width(0, JOINT_DESCRIPTION + JOINT_OBSERVATION)
    latent = width(1, first)
    value = width(2, JOINT_OBSERVATION)
    core, inputs = [], latent * value + GENERAL + STATIC
    for layer in range(3, 3 + _CORE_LAYERS):
        inputs = width(layer, inputs)
        core.append(inputs)
    width(3 + _CORE_LAYERS, latent)
    return PolicyConfig(
        key_widths=(first, latent),
        value_latent=value,
        core_widths=tuple(core),
        initial_temperature=hyperparameters.get("softmax_temperature", 1.0),
        minimum_temperature=hyperparameters.get("softmax_temperature_min", 0.025),
        mean_limit=hyperparameters.get("policy_mean_abs_clip", 10.0),
    )


def _params(weights):
    def dense(layer):
        return {part: weights[f"Dense_{layer}.{part}"] for part in ("kernel", "bias")}

    def norm(layer):
        return {part: weights[f"LayerNorm_{layer}.{part}"] for part in ("scale", "bias")}

    core = {"norm": norm(1)}
    for layer in range(_CORE_LAYERS):
        merged = dense(3 + layer)
        core[f"layer_{layer}"] = merged | {"scale": np.linalg.norm(merged["kernel"], axis=0)}
    return {
        "joint_encoder": {
            "key_kernel": weights["Dense_0.kernel"],
            "key_bias": weights["Dense_0.bias"],
            "key_norm": norm(0),
            "key_layers_0": dense(1),
            "value_kernel": weights["Dense_2.kernel"],
            "value_bias": weights["Dense_2.bias"],
            "log_temperature": weights["joint_log_softmax_temperature"],
        },
        "core": core,
        "log_std": dense(3 + _CORE_LAYERS),
    }


def _identity_constants():
    names = ("joint_descriptions", "static", "joint_observations", "general")
    return {name: identity(INPUT_SIZES[name]) for name in names}
