"""Exercise of 04_urma_networks."""

import numpy as np

from exercises import checker, need, same


@checker
def check_latent(function):
    """The sum over joints. function: (keys [n, L], values [n, v], mask [n]) -> latent [L, v]."""
    rng = np.random.default_rng(0)
    keys, values = rng.dirichlet(np.ones(6), 5), rng.normal(size=(5, 3))
    mask = np.array([1.0, 1, 0, 1, 0])
    right = same(function(keys, values, np.ones(5)), keys.T @ values)
    need(right, "Sum the outer products of key and value over the joints.")
    right = same(function(keys, values, mask), (keys.T * mask) @ values)
    need(right, "Joints with a mask of 0 are padding and must not count.")
    return "Neither padding nor the order of the joints has any influence."
