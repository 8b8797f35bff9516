"""Functions of many environments, computed for some of them at a time."""

import jax
import jax.numpy as jnp

CHUNK = 1024
"""Control steps whose networks are computed at a time on a CPU: their arrays fit its cache, which
nearly halves the time of a gradient."""


def number_of_chunks(environments: int, length: int) -> int:
    """In how many equal parts environments of `length` steps are computed, one after the other."""
    if jax.default_backend() != "cpu":
        return 1
    most = min(environments, max(1, environments * length // CHUNK))
    return next(n for n in range(most, 0, -1) if environments % n == 0)


def _chunked(tree, chunks: int):
    # Not -1 for the number of environments: a robot may have no collision spheres, so no numbers.
    return jax.tree.map(lambda x: x.reshape((chunks, x.shape[0] // chunks) + x.shape[1:]), tree)


def mapped(function, tree, chunks: int):
    """function(tree) of arrays [N, ...], computed in chunks of environments."""
    if chunks == 1:
        return function(tree)
    result = jax.lax.map(function, _chunked(tree, chunks))
    return jax.tree.map(lambda x: x.reshape((x.shape[0] * x.shape[1],) + x.shape[2:]), result)


def summed(function, tree, chunks: int):
    """Sum of function(chunk) over chunks of environments of arrays [N, ...]."""
    if chunks == 1:
        return function(tree)
    parts = _chunked(tree, chunks)
    shapes = jax.eval_shape(function, jax.tree.map(lambda x: x[0], parts))
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    def add(total, part):
        return jax.tree.map(jnp.add, total, function(part)), None

    return jax.lax.scan(add, zeros, parts)[0]
