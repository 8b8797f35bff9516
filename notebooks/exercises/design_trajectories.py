"""Exercises of 10_design_trajectories."""

from itertools import combinations

import numpy as np

from exercises import checker, need, same


@checker
def check_pair_distance(function):
    """Mean root-mean-square distance over all pairs of designs [S, d], without a loop."""
    for count, dim in ((2, 1), (3, 4), (10, 7)):
        designs = np.random.default_rng(0).uniform(-1, 1, (count, dim))
        pairs = [np.sqrt(np.mean((a - b) ** 2)) for a, b in combinations(designs, 2)]
        given, expected = function(designs), np.mean(pairs)
        hint = f"For {count} designs of {dim} entries a loop gives {expected:.4f}, not {given}."
        need(same(given, expected), f"{hint} No design is a pair with itself.")
    return "It agrees with a loop over all pairs."


@checker
def check_covered(function, trajectory):
    """The iteration at which a path [N + 1, d] has covered 90 %; trajectory: paths of starts."""
    found = []
    for path in np.moveaxis(trajectory, 1, 0):
        left = np.linalg.norm(path - path[-1], axis=1)
        found.append(int(np.argmax(left <= 0.1 * left[0])))
        hint = "Look for the first row whose distance to the last is a tenth of that of the first."
        need(same(function(path), found[-1]), f"It is iteration {found[-1]}. {hint}")
    return f"These starts need {min(found)} to {max(found)} of {len(trajectory) - 1} iterations."
