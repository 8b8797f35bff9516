"""Whether a found body is worth building: what a gain in return does not say."""

import functools

import jax
import numpy as np

from shapebody.arguments import require_integer, require_kind, require_number, require_shape
from shapebody.design.descriptions import describe
from shapebody.design.space import DesignSpace
from shapebody.evaluation.evaluate import Evaluation
from shapebody.evaluation.statistics import paired_gain
from shapebody.robot.robot import Robot

LARGE_CHANGE = 0.2
"""Share by which mass or a length may change before the body counts as another robot."""


def whole_body(space: DesignSpace, f) -> dict[str, tuple[float, float, str]]:
    """What changes of the whole body with design f [d]: name -> (reference, design, unit).

    Total mass (kg), the height of the IMU (m) and the three dimensions (m) in the nominal pose.

    Raises:
        ValueError: if f is not a design of this space.
    """
    require_kind("space", space, DesignSpace, "shapebody.DesignSpace(robot)")
    if space.validate(f).ndim != 1:
        raise ValueError(f"design has shape {np.shape(f)}; expected one design [{space.dim}]")
    both = np.stack([space.reference, space.validate(f)])
    told = _described(space.robot)(space(both))
    values = {"mass": (told.total_mass, "kg"), "height of the IMU": (told.imu_height, "m")}
    values |= {f"extent in {axis}": (told.dimensions[:, i], "m") for i, axis in enumerate("xyz")}
    return {name: (float(pair[0]), float(pair[1]), unit) for name, (pair, unit) in values.items()}


@functools.lru_cache(maxsize=4)
def _described(robot: Robot):
    """`describe`, compiled once for a robot."""
    return jax.jit(describe(robot))


def changes(space: DesignSpace, f, groups: int = 8) -> str:
    """A text on what design f [d] changes: the whole body, and the groups that change most.

    A group's number is the root mean square of its entries of f: 0 as in the reference, 1 as far as
    the design space goes.

    Raises:
        ValueError: if f is not a design of this space.
    """
    require_integer("groups", groups, 1)
    lines = ["the body, reference -> found:"]
    for name, (before, after, unit) in whole_body(space, f).items():
        lines.append(f"  {name:32s} {before:.3g} -> {after:.3g} {unit}")
    f = space.validate(f)
    size = {name: float(np.sqrt(np.mean(f[i] ** 2))) for name, i in space.groups.items()}
    most = sorted(size, key=size.get, reverse=True)[:groups]
    lines.append("what changed most (0: as in the reference, 1: as far as the design space goes):")
    return "\n".join(lines + [f"  {name:32s} {size[name]:.3f}" for name in most])


def large_changes(space: DesignSpace, f, limit: float = LARGE_CHANGE) -> list[str]:
    """One sentence per property of the whole body that design f [d] changes by more than `limit`.

    The properties are those of `whole_body`; `limit` is a share of the reference's value.

    Raises:
        ValueError: if f is not a design of this space.
    """
    require_number("limit", limit, 0)
    sentences = []
    for name, (before, after, unit) in whole_body(space, f).items():
        change = after / before - 1
        if abs(change) > limit:
            sentences.append(
                f"{name} {before:.3g} {unit} becomes {after:.3g} {unit} ({change:+.0%})"
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
