"""Exercises of 01_robots_and_designs."""

import jax
import numpy as np

from exercises import checker, need, same


@checker
def check_total_mass(function, space):
    """Mass in kg of the design whose three sizes are x, all else 0, without calling Φ."""
    for x in (-1.0, 0.0, 0.3, 1.0):
        f = space.reference.copy()
        f[space.slices["size"]] = x
        mass, given = space(f).body_mass.sum(), function(x)
        hint = "A body grows in three directions." if x else "That is the reference."
        need(
            same(given, mass, 1e-3 * mass), f"At x = {x:g} it is {mass:.3f} kg, not {given}. {hint}"
        )
    return "A robot of 1.8 times the length weighs 5.8 times as much."


@checker
def check_heavier(f, space):
    """The design nearest to the reference that is one kilogram heavier."""

    def mass(f):
        return space(f).body_mass.sum()

    gained, length = float(mass(f) - mass(space.reference)), np.linalg.norm(space.validate(f))
    need(abs(gained - 1) < 0.02, f"It gains {gained:+.3f} kg; Φ is not linear, correct the step.")
    # To first order, the shortest step is along the gradient.
    shortest = 1 / np.linalg.norm(jax.grad(mass)(space.reference))
    hint = f"The mass is right, but |f| = {shortest:.3f} is enough, along the gradient."
    need(length <= 1.05 * shortest, hint)
    return f"{gained:+.3f} kg with |f| = {length:.3f}."
