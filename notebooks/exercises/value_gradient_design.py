"""Exercises of 06_value_gradient_design."""

import numpy as np

from exercises import checker, need, same


@checker
def check_step(function):
    """The two clips of eq. (7), δ_max = 0.1; function: (f [d], Adam's step [d]) -> [d]."""
    f = np.array([0.0, 0.0, 0.0, 0.95, -0.95, 0.98])
    step = np.array([0.05, 0.3, -0.3, 0.3, -0.4, -0.5])
    given, expected = function(f, step), np.clip(f + np.clip(step, -0.1, 0.1), -1, 1)
    right = same(given, expected)
    need(np.abs(given).max() <= 1, "An entry leaves [-1, 1]; the outer clip keeps it inside.")
    need(np.abs(given - f).max() <= 0.1 + 1e-6, "An entry moves by more than 0.1; clip the step.")
    need(right, f"From {f} the steps {step} lead to {expected}.")
    return "Both clips are in their places."


@checker
def check_radius(function):
    """Where a value gradient g balances the penalty of λ; function: (g, λ) -> |f - f_ref|."""
    for g, size in ((0.1, 20.0), (-0.1, 100.0), (5.0, 20.0)):
        given, balance = function(g, size), 358 * abs(g) / (2 * size)
        hint = "Set the derivative of the penalty, 2 λ (f - f_ref) / d, equal to g."
        if given is not None and same(given, balance):
            hint = "No entry can leave the box, so the distance is at most 1."
        need(same(given, min(balance, 1), 1e-3), f"For g = {g:g} and λ = {size:g}: {hint}")
    return "A larger λ means a proportionally smaller distance."
