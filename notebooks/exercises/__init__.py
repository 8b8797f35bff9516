"""Checkers of the notebooks' exercises, one module per notebook.

A checker prints "Right" and why, or "Not yet" with a hint about the first case that is wrong.
"""

import functools

import numpy as np


class NotYet(Exception):
    """The hint for an answer that is not right yet."""


def checker(check):
    """Print what `check` returns for a right answer, or the hint that it raises."""

    @functools.wraps(check)
    def run(answer, *more):
        try:
            need(answer is not None, "Nothing is answered so far.")
            print("Right.", check(answer, *more))
        except NotYet as hint:
            print("Not yet.", hint)

    return run


def need(right, hint: str) -> None:
    """Stop with that hint unless something is right."""
    if not right:
        raise NotYet(hint)


def same(given, expected, tolerance: float = 1e-4) -> bool:
    """Whether an answer has the numbers that are expected; NaN is never the same."""
    need(given is not None, "The function returns None so far.")
    given, expected = np.asarray(given, float), np.asarray(expected, float)
    need(given.shape == expected.shape, f"Expected the shape {expected.shape}, got {given.shape}.")
    return bool(np.all(np.abs(given - expected) <= tolerance))
