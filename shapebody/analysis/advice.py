"""Whether a found body is worth building: what a gain in return does not say."""

import jax
import numpy as np

from shapebody.arguments import require_integer, require_kind, require_number, require_shape
from shapebody.design.descriptions import describe
from shapebody.design.space import DesignSpace
from shapebody.evaluation.evaluate import Evaluation
from shapebody.evaluation.statistics import paired_gain

LARGE_CHANGE = 0.2
"""Share by which mass or a length may change before the body counts as another robot."""


def large_changes(space: DesignSpace, f, limit: float = LARGE_CHANGE) -> list[str]:
    """One sentence per property of the whole body that design f [d] changes by more than `limit`.

    The properties are the total mass (kg), the height of the IMU (m) and the three dimensions (m)
    in the nominal pose; `limit` is a share of the reference's value.

    Raises:
        ValueError: if f is not a design of this space.
    """
    require_kind("space", space, DesignSpace, "shapebody.DesignSpace(robot)")
    require_number("limit", limit, 0)
    if space.validate(f).ndim != 1:
        raise ValueError(f"design has shape {np.shape(f)}; expected one design [{space.dim}]")
    both = np.stack([space.reference, space.validate(f)])
    told = jax.jit(describe(space.robot))(space(both))
    values = {"mass, kg": told.total_mass, "height of the IMU, m": told.imu_height}
    values |= {f"extent in {axis}, m": told.dimensions[:, i] for i, axis in enumerate("xyz")}
    sentences = []
    for name, (before, after) in values.items():
        change = float(after / before - 1)
        if abs(change) > limit:
            what, unit = name.split(", ")
            sentences.append(
                f"{what} {before:.3g} {unit} becomes {after:.3g} {unit} ({change:+.0%})"
            )
    return sentences


def objections(walked: Evaluation, stood: Evaluation, row: int, reference: int = 0) -> list[str]:
    """What the episodes say against building design `row`, one sentence each; empty if nothing.

    A design has to earn more than the body that it would replace, and more than standing still with
    either of the two. It must not track worse, and not fall earlier.

    Args:
        walked: episodes of the policy on the designs [S].
        stood: the same episodes of the same designs without a policy (actions zero).
        row, reference: numbers of the design, and of the body that it would replace.

    Raises:
        ValueError: if the two evaluations differ in seed or settings.
    """
    for name, value in (("walked", walked), ("stood", stood)):
        require_kind(name, value, Evaluation, "shapebody.evaluate(...)")
        require_shape(f"{name}.returns", value.returns, ("S", "E"))
    for name, value in (("row", row), ("reference", reference)):
        require_integer(name, value, 0, len(walked.returns) - 1)
    paired_gain(walked, stood)  # refuses evaluations that cannot be compared
    sentences = []
    for other, before in (
        ("the body as written", walked.returns[reference]),
        ("standing still with the same body", stood.returns[row]),
        ("standing still with the body as written", stood.returns[reference]),
    ):
        gain = paired_gain(walked.returns[row], before)
        if gain.low <= 0:
            interval = f"{gain.mean:+.2f} [{gain.low:+.2f}, {gain.high:+.2f}]"
            sentences.append(f"not shown to earn more than {other}: {interval}")
    errors, lengths = walked.tracking_error.mean(-1), walked.lengths.mean(-1)
    if errors[row] > errors[reference]:
        sentences.append(f"tracks worse: {errors[row]:.3f} m/s, not {errors[reference]:.3f} m/s")
    if lengths[row] < lengths[reference]:
        sentences.append(f"falls earlier: {lengths[row]:.0f} steps, not {lengths[reference]:.0f}")
    return sentences
