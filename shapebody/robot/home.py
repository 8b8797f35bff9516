"""The nominal pose of a robot file that has none, and the height at which it stands in it."""

import re
from collections.abc import Iterator

import mujoco
import numpy as np
from scipy.optimize import least_squares

from shapebody.robot.entries import home_qpos
from shapebody.robot.feet import foot_ids, leg_ends
from shapebody.robot.geometry import leg_length, lowest, posed
from shapebody.robot.spec_edits import listed

_JOINT = mujoco.mjtJoint


FLOOR_TOLERANCE = 0.05  # of the home height: how far feet may be from the floor

_STANDING = re.compile("home|stand|nominal|default|init", re.IGNORECASE)


def infer_home(spec, model) -> Iterator[str]:
    """Keyframe "home": another keyframe, or the pose in which the file is drawn.

    There all joints are at zero, or at their `ref`; or as near to it as their limits allow.
    """
    if any(key.name == "home" for key in spec.keys):
        return
    hint = (
        f'to say it yourself add <keyframe><key name="home" qpos="..."/></keyframe> with '
        f"{model.nq} numbers"
    )
    named = [key for key in spec.keys if _STANDING.search(key.name)] or list(spec.keys)
    if named:
        qpos = np.array(model.key_qpos[named[0].id])
        note = f"the nominal pose is that of keyframe {named[0].name!r}"
    else:
        qpos, moved = _near_zero(model)
        note = _drawn(model)
        if moved:
            note += (
                f", but {listed(moved)} at the nearest position within their limits, and the "
                "others so that the feet stay below the body"
            )
    for key in list(spec.keys):
        spec.delete(key)
    spec.add_key(name="home", qpos=qpos)
    yield f'no keyframe "home": {note}; {hint}'


def infer_height(spec, model) -> Iterator[str]:
    """The trunk in "home" so high that the lowest foot touches the floor."""
    feet = foot_ids(model)
    if len(feet) == 0:
        return
    qpos = home_qpos(model)
    data = posed(model, qpos)
    gap = min(lowest(model, data, foot) for foot in feet)
    height = data.xpos[1, 2] - gap
    if abs(gap) <= FLOOR_TOLERANCE * height:
        return
    qpos[2] -= gap
    spec.key("home").qpos = qpos
    side = "above" if gap > 0 else "below"
    yield (
        f'the feet of "home" are {abs(gap):.3f} m {side} the floor: the trunk is moved to z = '
        f"{qpos[2]:.4f} m; to say it yourself correct the third number of qpos"
    )


def _drawn(model) -> str:
    """The pose in which a file is drawn, for a note: zero, or what `ref` says."""
    hinges = np.flatnonzero(model.jnt_type == _JOINT.mjJNT_HINGE)
    angles = model.qpos0[model.jnt_qposadr[hinges]]
    names: dict[str, list[str]] = {}
    for joint, angle in zip(hinges, angles, strict=True):
        if angle:
            names.setdefault(f"{angle:.3g}", []).append(model.joint(int(joint)).name)
    if not names:
        return "the nominal pose has all joints at zero"
    places = "; ".join(f"{listed(group)} at {angle} rad" for angle, group in names.items())
    rest = "" if np.all(angles) else ", the others at zero"
    return f"the nominal pose is the one that is drawn, with joints at their ref: {places}{rest}"


def _near_zero(model) -> tuple[np.ndarray, list[str]]:
    """qpos [nq] within limits near qpos0, and names of the joints that qpos0 puts outside.

    If there are any, the others move so that the leg ends stay where qpos0 has them, seen from
    above: bent knees alone would put the feet beside the body.
    """
    hinges = np.flatnonzero(model.jnt_type == _JOINT.mjJNT_HINGE)
    where = model.jnt_qposadr[hinges]
    low, high = model.jnt_range[hinges].T
    qpos = np.array(model.qpos0)
    clipped = np.clip(qpos[where], low, high)
    moved = [model.joint(int(j)).name for j in hinges[clipped != qpos[where]]]
    if not moved:
        return qpos, moved
    data = mujoco.MjData(model)
    ends = [geoms[0] for geoms in leg_ends(model, _with(qpos, where, clipped)).values()]
    if not ends:
        return _with(qpos, where, clipped), moved

    def positions(angles):
        data.qpos[:] = _with(qpos, where, angles)
        mujoco.mj_kinematics(model, data)
        return data.geom_xpos[ends, :2].ravel()

    goal = positions(qpos[where])
    length = leg_length(model, ends)
    margin = 0.1 * (high - low)  # the soft limits of the method are inside the hard ones
    bounds = low + margin, high - margin
    start = np.clip(qpos[where], *bounds)

    def residual(angles):
        return np.concatenate([(positions(angles) - goal) / length, 0.03 * (angles - start)])

    found = least_squares(residual, start, bounds=(bounds[0] - 1e-9, bounds[1] + 1e-9))
    return _with(qpos, where, np.round(found.x, 4)), moved


def _with(qpos, where, angles) -> np.ndarray:
    qpos = np.array(qpos)
    qpos[where] = angles
    return qpos
