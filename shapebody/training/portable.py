"""A run's state that is small enough for a repository.

`training.safetensors` continues a run bit by bit. It holds the networks, both moments of Adam for
every weight, and all of the environments; several megabytes that change with every iteration. Here
are the weights, the moments rounded to a byte each, and c of every environment: a third of that. A
run that begins from them has the same networks and the same curriculum, and begins new episodes.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax

from shapebody.files import load_arrays, save_arrays
from shapebody.training.update import Learner

OCTAVES = 16
"""Second moments below 2^-32 of the largest one in their array count as that."""


def save_portable(path: Path, learner: Learner, coefficient, seconds: float) -> None:
    """Write the state.

    Args:
        path: of the file.
        learner: of the run.
        coefficient: float32 [N], c of every environment.
        seconds: that the run took so far.
    """
    save_arrays(path, _packed(learner, coefficient, seconds))


def load_portable(path: Path, learner: Learner, environments: int):
    """(Learner, c [N], seconds) from a file of `save_portable`.

    Args:
        path: of the file.
        learner: one of the same run, such as a new one, whose structure it has.
        environments: their number N.

    Raises:
        ValueError: if the file is damaged, or of another run.
    """
    like = _packed(learner, np.zeros(environments, np.float32), 0.0)
    saved = load_arrays(path, like)
    policy = {**learner.policy, **saved["policy"]}
    average = None
    if learner.average is not None:
        average = jax.tree.map(jnp.add, saved["policy"]["params"], _apart(saved["average"]))
    new = Learner(
        policy=policy,
        critic={**learner.critic, **saved["critic"]},
        policy_optimizer=_with_moments(learner.policy_optimizer, saved["policy_moments"]),
        critic_optimizer=_with_moments(learner.critic_optimizer, saved["critic_moments"]),
        iteration=saved["learner"]["iteration"],
        average=average,
    )
    return new, np.asarray(saved["coefficient"]), float(saved["seconds"])


def _packed(learner: Learner, coefficient, seconds: float) -> dict:
    average = None
    if learner.average is not None:
        # Near the weights themselves: the small difference is rounded.
        apart = jax.tree.map(jnp.subtract, learner.average, learner.policy["params"])
        average = jax.tree.map(_rounded, apart)
    return {
        "learner": {"iteration": learner.iteration},
        "policy": learner.policy,
        "critic": learner.critic,
        "policy_moments": _moments(learner.policy_optimizer),
        "critic_moments": _moments(learner.critic_optimizer),
        "average": average,
        "coefficient": np.asarray(coefficient, np.float32),
        "seconds": np.float64(seconds),
    }


# ---------------------------------------------------------------------- Adam's moments


def _moments(state) -> dict:
    """Count and moments of an optimizer's state, rounded."""
    return {
        "count": optax.tree.get(state, "count"),
        "mu": jax.tree.map(_rounded, optax.tree.get(state, "mu")),
        "nu": jax.tree.map(_rounded_octaves, optax.tree.get(state, "nu")),
    }


def _with_moments(state, saved):
    """An optimizer's state with the moments that were saved."""
    return optax.tree.set(
        state,
        count=saved["count"],
        mu=_apart(saved["mu"]),
        nu=_apart(saved["nu"], octaves=True),
    )


def _rounded(x) -> dict:
    """An array as int8 times a scale: exact to 1/254 of its largest entry."""
    scale = jnp.maximum(jnp.max(jnp.abs(x)), 1e-30) / 127
    return {"codes": np.asarray(jnp.round(x / scale), np.int8), "scale": np.float32(scale)}


def _rounded_octaves(x) -> dict:
    """Numbers of at least 0 by their logarithms: exact to 4 % over a range of 2^32."""
    scale = jnp.maximum(jnp.max(x), 1e-30)
    codes = 255 + jnp.round(255 / (2 * OCTAVES) * jnp.log2(jnp.maximum(x / scale, 1e-30)))
    return {"codes": np.asarray(jnp.clip(codes, 0, 255), np.uint8), "scale": np.float32(scale)}


def _is_rounded(x) -> bool:
    return isinstance(x, dict) and x.keys() == {"codes", "scale"}


def _apart(tree, octaves: bool = False):
    """A tree of rounded arrays as float32."""

    def restored(rounded):
        codes = jnp.asarray(rounded["codes"], jnp.float32)
        if octaves:
            codes = 2.0 ** ((codes - 255) * (2 * OCTAVES / 255))
        return codes * rounded["scale"]

    return jax.tree.map(restored, tree, is_leaf=_is_rounded)
