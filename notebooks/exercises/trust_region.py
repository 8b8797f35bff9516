"""Exercises of 08_trust_region."""

from itertools import combinations

import numpy as np

from exercises import checker, need, same


@checker
def check_penalty_coefficient(function):
    """The λ at which a random design pays the penalty p, if all entries of f_ref are a."""
    for p, a in ((33.0, 0.0), (10.0, 0.5), (4.0, -1.0)):
        hint = "Find the mean of (f - a)² for one entry f; " + ("a counts too." if a else "a = 0.")
        need(same(function(p, a), p / (1 / 3 + a**2), 1e-3), f"For p = {p:g}, a = {a:g}: {hint}")
    return "For a = 0 it is 3 p: at λ = 100 a random design pays about 33."


@checker
def check_held_out(answer, gains, sizes):
    """λ chosen on the first half of the starts, its mean gain there, and on the other half.

    gains: [λ, start]; sizes: the λ of its rows.
    """
    count = gains.shape[1]

    def chosen(half):
        inside = np.isin(np.arange(count), half)
        best = int(np.argmax(gains[:, inside].mean(1)))
        return sizes[best], gains[best, inside].mean(), gains[best, ~inside].mean()

    size, *means = chosen(range(count // 2))
    need(answer[0] == size, "λ has the largest mean over the first half of the columns only.")
    need(same(answer[1:], means, 1e-2), "The means are those of one row, over each half.")
    splits = [chosen(half)[1:] for half in combinations(range(count), count // 2)]
    inside, outside = np.mean(splits, axis=0)
    return f"Over all {len(splits)} halves it gains {inside:+.2f} inside, {outside:+.2f} outside."
