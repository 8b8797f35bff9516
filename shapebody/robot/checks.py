"""Checks of a compiled robot file. Each yields one message per problem: what, expected, fix.

They judge what cannot be inferred. What is only missing is added by `shapebody.robot.completion`.
"""

from collections.abc import Callable, Iterator

import mujoco
import numpy as np

from shapebody.robot.entries import custom_numeric, home_qpos
from shapebody.robot.feet import ends_without_foot, foot_ids
from shapebody.robot.finite import check_numbers, is_finite
from shapebody.robot.geometry import lowest, posed, standing_height
from shapebody.robot.spec_edits import COLLISION_GROUP, each, listed

_JOINT, _OBJ = mujoco.mjtJoint, mujoco.mjtObj


MIN_MASS, MIN_INERTIA = 1e-7, 1e-11  # kg, kg m²; those of real robots are above 1e-6 and 1e-10

FAR = 1e4  # m and rad, beyond which there is no robot

MAX_TILT = 45.0  # degrees of the trunk in "home"


def check_tree(model: mujoco.MjModel) -> Iterator[str]:
    """One floating body; every other body hangs from it."""
    free = np.flatnonzero(model.jnt_type == _JOINT.mjJNT_FREE)
    outermost = np.flatnonzero(model.body_parentid == 0)[1:]  # without the world itself
    if model.nbody == 1:
        yield "no bodies: expected a robot; add its trunk, with a <freejoint/>, to the worldbody"
        return
    if len(free) == 0:
        base = _name(model, _OBJ.mjOBJ_BODY, 1)
        held = [_name(model, _OBJ.mjOBJ_JOINT, j) for j in np.flatnonzero(model.jnt_bodyid == 1)]
        how = f" by {each('joint', held).removeprefix('each of ')}" if held else ""
        verb = "ties" if held else "fixes"
        yield (
            f"no free joint: expected exactly one, in the trunk; the file {verb} the base {base} "
            f"to the world{how}, as that of an arm on a table, which cannot be used. If the robot "
            "walks, add <freejoint/> to the first body of the worldbody, in place of joints that "
            "tie it to the world (in a URDF, make the link of the trunk the root)"
        )
    elif len(free) > 1:
        bodies = ", ".join(_name(model, _OBJ.mjOBJ_BODY, model.jnt_bodyid[j]) for j in free)
        yield f"{len(free)} free joints (bodies {bodies}): expected exactly one; keep the trunk's"
    floating = model.jnt_bodyid[free]
    trunk = int(floating[0]) if len(free) == 1 else max(outermost, key=_size_of(model))
    loose = [int(body) for body in outermost if body != trunk]
    if loose:
        names = (_name(model, _OBJ.mjOBJ_BODY, body) for body in loose)
        yield (
            f"{each('body', names)} is not part of the robot, whose trunk is "
            f"{_name(model, _OBJ.mjOBJ_BODY, trunk)}: expected one tree below the trunk; remove or "
            "attach what is beside it"
        )


def _size_of(model: mujoco.MjModel) -> Callable[[int], int]:
    """Number of bodies in the tree of an outermost body."""
    return lambda body: int(np.sum(model.body_rootid == body))


def check_joints(model: mujoco.MjModel) -> Iterator[str]:
    """Hinge joints with limits."""
    found: dict[str, list[str]] = {}
    for joint in range(model.njnt):
        kind, (low, high) = _JOINT(model.jnt_type[joint]), model.jnt_range[joint]
        if kind == _JOINT.mjJNT_HINGE and not (model.jnt_limited[joint] and low < high):
            finding = f"{low:g} {high:g}" if low or high else "none"
        else:
            finding = {_JOINT.mjJNT_BALL: "ball", _JOINT.mjJNT_SLIDE: "slide"}.get(kind)
        found.setdefault(finding, []).append(_name(model, _OBJ.mjOBJ_JOINT, joint))
    found.pop(None, None)
    for finding, names in found.items():
        if finding in ("ball", "slide"):
            yield (
                f"{each('joint', names)} is a {finding} joint: "
                "expected hinge joints only; replace by hinges or remove"
            )
        elif finding == "none":
            yield (
                f'{each("joint", names)} has no limits: expected range="lower upper" with lower < '
                "upper; add the range of the real joint (in a URDF, type revolute with <limit>)"
            )
        else:
            yield (
                f'{each("joint", names)} has range="{finding}", which sets no limits: expected '
                'lower < upper and no limited="false"; correct the range (in a URDF, lower and '
                "upper of <limit>)"
            )


def check_masses(model: mujoco.MjModel) -> Iterator[str]:
    """Bodies that move have mass and inertia."""
    moving = model.body_weldid
    found: dict[str, list[str]] = {}
    for body in range(1, model.nbody):
        if model.body_dofnum[body] == 0:
            continue
        mass = model.body_mass[moving == body].sum()
        inertia = model.body_inertia[moving == body].max(axis=0).min()
        if not (mass >= MIN_MASS and inertia >= MIN_INERTIA):
            # Values below 1e-9 were put by `read` in place of missing ones.
            shown = f"{mass if mass > 1e-9 else 0:g} kg and {inertia if inertia > 1e-13 else 0:g}"
            found.setdefault(shown, []).append(_name(model, _OBJ.mjOBJ_BODY, body))
    for shown, names in found.items():
        yield (
            f"{each('body', names)} has mass and inertia {shown} kg m²: expected at least "
            f"{MIN_MASS:g} and {MIN_INERTIA:g} for a body that moves; add "
            '<inertial pos="..." mass="..." diaginertia="..."/> (in a URDF, <inertial> with '
            "<mass> and a positive definite <inertia>)"
        )


def check_loops(model: mujoco.MjModel) -> Iterator[str]:
    """A tree of rigid bodies: no equality constraints, nothing soft."""
    for kind in np.unique(model.eq_type):
        label = mujoco.mjtEq(kind).name.removeprefix("mjEQ_").lower()
        ids = np.flatnonzero(model.eq_type == kind)
        names = [_constraint(model, int(index)) for index in ids]
        yield (
            f"{len(ids)} equality constraints of type {label} ({listed(names)}): expected none, "
            "since a design would pull the constrained parts apart; drive the joints directly (a "
            "mimic joint: by an actuator of its own, or make it fixed)"
        )
    if model.nflex:
        yield f"{model.nflex} flexible bodies: expected rigid bodies only; remove <flexcomp>"


def _constraint(model: mujoco.MjModel, index: int) -> str:
    """Name of an equality constraint, or what it ties to what."""
    if model.eq(index).name:
        return repr(model.eq(index).name)
    kind = {
        mujoco.mjtEq.mjEQ_JOINT: _OBJ.mjOBJ_JOINT,
        mujoco.mjtEq.mjEQ_TENDON: _OBJ.mjOBJ_TENDON,
    }.get(mujoco.mjtEq(model.eq_type[index]), _OBJ(model.eq_objtype[index]))
    ends = (model.eq_obj1id[index], model.eq_obj2id[index])
    return " with ".join(_name(model, kind, end) for end in ends if end >= 0)


def check_actuators(model: mujoco.MjModel) -> Iterator[str]:
    """At most one actuator per hinge joint, and something to drive."""
    if not np.any(model.jnt_type == _JOINT.mjJNT_HINGE):
        yield (
            "no hinge joints: expected at least one to drive; add "
            '<joint axis="..." range="..."/> to the bodies that move, and an <actuator> section'
        )
    driven: dict[int, str] = {}
    others = []
    for actuator in range(model.nu):
        name = _name(model, _OBJ.mjOBJ_ACTUATOR, actuator)
        joint = int(model.actuator_trnid[actuator, 0])
        if (
            mujoco.mjtTrn(model.actuator_trntype[actuator])
            not in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
            or model.jnt_type[joint] != _JOINT.mjJNT_HINGE
        ):
            others.append(name)
            continue
        if joint in driven:
            yield (
                f"actuators {driven[joint]} and {name} drive the same joint "
                f"{_name(model, _OBJ.mjOBJ_JOINT, joint)}: expected one per joint; remove one"
            )
        driven.setdefault(joint, name)
    if others:
        yield (
            f"{each('actuator', others)} does not drive one hinge joint: expected "
            'joint="<hinge>"; replace tendon, site, body or free-joint transmissions'
        )


def check_feet(model: mujoco.MjModel) -> Iterator[str]:
    """Feet at the ends of legs. For the completed model."""
    feet = foot_ids(model)
    fixed = [foot for foot in feet if model.body_weldid[model.geom_bodyid[foot]] == 1]
    if fixed:
        names = [_name(model, _OBJ.mjOBJ_GEOM, foot) for foot in fixed]
        bodies = [
            _name(model, _OBJ.mjOBJ_BODY, b) for b in ends_without_foot(model, home_qpos(model))
        ]
        also = f", and put it into those of bodies {listed(bodies)}" if bodies else ""
        yield (
            f"{each('geom', names)} is rigidly on the trunk "
            f'{_name(model, _OBJ.mjOBJ_BODY, 1)}, but "foot" in a name says that it is a foot: '
            "expected feet at the ends of legs that move; take the word out of these names" + also
        )
    both = [foot for foot in feet if model.geom_group[foot] == COLLISION_GROUP]
    if both:
        names = [_name(model, _OBJ.mjOBJ_GEOM, foot) for foot in both]
        yield (
            f"{each('geom', names)} is both a foot and a collision sphere of group "
            f"{COLLISION_GROUP}: expected one or the other; use another group for the foot"
        )
    if len(feet) == 0:
        yield (
            'no geom has "foot" in its name, and no leg ends in a geom that could be a foot: '
            "expected one sphere or box per foot; add them where the robot touches the floor, e.g. "
            '<geom name="left_foot" type="sphere" size="0.02" pos="0 0 -0.2"/>'
        )


def check_home(model: mujoco.MjModel) -> Iterator[str]:
    """A trunk with z up, above the feet, in "home". For the completed model."""
    feet, trunk = foot_ids(model), _name(model, _OBJ.mjOBJ_BODY, 1)
    if len(feet) == 0:
        return
    data = posed(model, home_qpos(model))
    height = data.xpos[1, 2] - min(lowest(model, data, foot) for foot in feet)
    if tilt(data.qpos) > MAX_TILT:
        yield (
            f'the trunk {trunk} is tilted by {tilt(data.qpos):.0f} degrees in "home": expected its '
            "frame with x forward and z up; turn the trunk frame until its z axis points up, or "
            "correct the quaternion (numbers 4 to 7 of qpos)"
        )
    elif height <= 0.01 * standing_height(model, data):
        side = "below" if height < 0 else "above"
        arm = (
            ". A chain that stands up from its base is an arm, which cannot be used"
            if len(feet) == 1 and height < 0
            else ""
        )
        yield (
            f"the origin of the trunk {trunk} is {abs(height):.3f} m {side} the lowest foot in "
            '"home": expected it well above, in the trunk; move the origin up, and all that is in '
            "the trunk down by as much (in a URDF, make the link of the trunk the root)" + arm
        )


def check_poses(model: mujoco.MjModel) -> Iterator[str]:
    """Keyframes near the origin: with larger numbers no digits are left for the feet."""
    for key, qpos in enumerate(model.key_qpos):
        far = np.flatnonzero((np.abs(qpos) > FAR) & is_finite(qpos))
        if len(far):
            shown = listed(f"{qpos[i]:g} (number {i + 1})" for i in far)
            yield (
                f"qpos of keyframe {_name(model, _OBJ.mjOBJ_KEY, key)} has {shown}: expected at "
                f"most {FAR:g} m and rad; correct it"
            )


def tilt(qpos) -> float:
    """Angle between the z axis of the trunk and the vertical, degrees."""
    _, x, y, _ = qpos[3:7] / np.linalg.norm(qpos[3:7])
    return float(np.degrees(np.arccos(np.clip(1 - 2 * (x * x + y * y), -1, 1))))


def check_ranges(model: mujoco.MjModel) -> Iterator[str]:
    """Torque ranges that a motor can have: they contain 0 and reach above it."""
    ranges = [
        ("forcerange", _OBJ.mjOBJ_ACTUATOR, i, model.actuator_forcerange[i])
        for i in range(model.nu)
    ]
    ranges += [
        ("actuatorfrcrange", _OBJ.mjOBJ_JOINT, joint, model.jnt_actfrcrange[joint])
        for joint in range(model.njnt)
    ]
    # The control of a motor is its torque; that of a servo is a position.
    ranges += [
        ("ctrlrange", _OBJ.mjOBJ_ACTUATOR, i, model.actuator_ctrlrange[i])
        for i in range(model.nu)
        if model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_NONE
    ]
    found: dict[tuple[str, str], list[str]] = {}
    for attribute, kind, index, (low, high) in ranges:
        if (low or high) and not low <= 0 < high and is_finite((low, high)).all():
            names = found.setdefault((attribute, f"{low:g} {high:g}"), [])
            names.append(_name(model, kind, index))
    for (attribute, shown), names in found.items():
        element = "joint" if attribute == "actuatorfrcrange" else "actuator"
        yield (
            f'{attribute} of {each(element, names)} is "{shown}": expected a range that contains 0 '
            'and has a positive maximum, such as "-10 10" (N m); correct it'
        )


def check_spheres(model: mujoco.MjModel) -> Iterator[str]:
    """Geoms of group 5 are collision spheres."""
    other = (model.geom_group == COLLISION_GROUP) & (
        model.geom_type != mujoco.mjtGeom.mjGEOM_SPHERE
    )
    names = [_name(model, _OBJ.mjOBJ_GEOM, geom) for geom in np.flatnonzero(other)]
    if names:
        yield (
            f"{each('geom', names)} of group {COLLISION_GROUP} is not a sphere: "
            "that group is kept for collision spheres; use another group"
        )


def check_custom(model: mujoco.MjModel) -> Iterator[str]:
    """Custom numbers: action scale, velocity limits and keep-nominal flags."""
    scale, speeds, keep = (
        custom_numeric(model, name) for name in ("action_scale", "velocity_limits", "keep_nominal")
    )
    if scale is not None and not (scale.shape == (1,) and scale[0] > 0 and is_finite(scale[0])):
        yield (
            f'custom numeric "action_scale" is {_shown(scale)}: expected one number > 0 (rad); '
            'write <custom><numeric name="action_scale" data="0.3"/></custom>'
        )
    count = model.nu or int(np.sum(model.jnt_type == _JOINT.mjJNT_HINGE))
    if speeds is not None and not (
        speeds.shape == (count,) and np.all((speeds > 0) & is_finite(speeds))
    ):
        yield (
            f'custom numeric "velocity_limits" is {_shown(speeds)}: expected {count} numbers '
            "> 0 (rad/s, one per actuator, in actuator order); write "
            '<custom><numeric name="velocity_limits" data="..."/></custom>'
        )
    if keep is not None and (keep.shape != (count,) or not np.all((keep == 0) | (keep == 1))):
        yield (
            f'custom numeric "keep_nominal" is {_shown(keep)}: expected {count} flags 0 or 1 '
            "(one per actuator); correct or remove it"
        )


CHECKS: tuple[Callable[[mujoco.MjModel], Iterator[str]], ...] = (
    check_tree,
    check_joints,
    check_numbers,
    check_masses,
    check_loops,
    check_actuators,
    check_ranges,
    check_spheres,
    check_poses,
    check_custom,
)


def _name(model: mujoco.MjModel, kind: mujoco.mjtObj, index: int) -> str:
    return repr(mujoco.mj_id2name(model, kind, int(index)) or f"number {index}")


def _shown(values: np.ndarray) -> str:
    return np.array2string(values, threshold=6)
