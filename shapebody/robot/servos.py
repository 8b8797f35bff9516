"""Position servos for a robot file with motors, with other drives or without actuators."""

from collections.abc import Iterator

import mujoco
import numpy as np

from shapebody.robot.entries import home_qpos
from shapebody.robot.feet import foot_ids
from shapebody.robot.geometry import leg_length
from shapebody.robot.spec_edits import listed, ordered
from shapebody.robot.urdf import ARMATURE

_JOINT, _TRN = mujoco.mjtJoint, mujoco.mjtTrn


GAIN_PER_MASS = 1.5  # N m/rad per kg; the median of the 50 robots is 1.6

GAIN_RANGE = 20.0, 80.0  # N m/rad

GAIN_RATIO = 40.0  # 1/s, P over D gain


def infer_actuators(spec, model) -> Iterator[str]:
    """Position servos with symmetric torque limits and one pair of gains for the whole robot.

    P and D gain are the medians of the file's position servos. Without any, P is 1.5 N m/rad per
    kg of the robot, within 20 and 80, and D = P / 40: for the 50 robots of the paper P is within a
    factor 1.5 of the paper's for 92 %, D within a factor 2 for all (1.5 for 84 %). Gains that the
    file does not give need inertia at the joint: where it has no armature either, it gets that of
    a URDF.
    Without a torque limit in the file (of the actuator, of its control range or of the joint) it is
    `leg_torque`.
    """
    hinges = np.flatnonzero(model.jnt_type == _JOINT.mjJNT_HINGE)
    if model.nu == 0 and len(hinges) == 0:
        return
    servos = np.array([_is_servo(model, i) for i in range(model.nu)], bool)
    gains = np.array([_gains(model, i) for i in np.flatnonzero(servos)]).reshape(-1, 2)
    driven = model.actuator_trnid[:, 0] if model.nu else hinges
    if model.nu and servos.all() and _fits(model, gains):
        return
    joints = {joint.id: joint for joint in spec.joints}

    # Which joints are driven, and by what.
    if model.nu == 0:
        yield (
            f"no actuators: one position servo for each of the {len(hinges)} hinge joints; to say "
            "it yourself add an <actuator> section"
        )
        for joint in driven:
            spec.add_actuator(name=joints[joint].name, target=joints[joint].name)
    elif not servos.all():
        others = [_actuator_name(model, i) for i in np.flatnonzero(~servos)]
        yield (
            f"actuators {listed(others)} are motors or other drives: replaced by position "
            "servos, the form of control of the method; to say it yourself use <position>"
        )

    # One pair of gains, and inertia at the joints where the file does not give it.
    (p_gain, d_gain), note = _chosen_gains(model, gains)
    if note:
        yield note
    yield from _add_armature(model, joints, driven[~servos] if model.nu else driven)

    # Torque limits of the actuators alone, the same in both directions.
    limits, note = _chosen_limits(model, driven)
    if note:
        yield note
    yield from _changed_ranges(model, servos, driven)

    for actuator, joint, limit in zip(ordered(spec.actuators), driven, limits, strict=True):
        _make_servo(actuator, joints[int(joint)], p_gain, d_gain, limit)
    _hold_home(spec, model, driven)


def _fits(model, gains) -> bool:
    """Whether position servos with these gains [nu, 2] are already as the method has them."""
    driven = model.actuator_trnid[:, 0]
    return bool(
        len(np.unique(gains, axis=0)) == 1
        and np.all(model.actuator_trntype == _TRN.mjTRN_JOINT)
        and np.all(model.actuator_gear[:, 0] == 1)
        and np.all(model.actuator_forcelimited)
        and np.all(model.actuator_forcerange[:, 0] == -model.actuator_forcerange[:, 1])
        and not np.any(model.actuator_ctrllimited)
        and not np.any(model.jnt_actfrclimited[driven])
    )


def _add_armature(model, joints, drives) -> Iterator[str]:
    """Armature of the joints `drives` that have none; `joints` are those of the spec by ids."""
    light = [int(joint) for joint in drives if model.dof_armature[model.jnt_dofadr[joint]] == 0]
    for joint in light:
        joints[joint].armature = ARMATURE
    if light:
        yield (
            f"no armature of joints {listed(model.joint(j).name for j in light)}: {ARMATURE:g} kg "
            "m², the inertia of a motor as the joint feels it; to say it yourself add "
            f'armature="{ARMATURE:g}" to the joints'
        )


def _chosen_limits(model, driven) -> tuple[list[float], str]:
    """Torque limit of each driven joint, N m, and a note if the file lacks some."""
    if model.nu:
        limits = [_torque_limit(model, i) for i in range(model.nu)]
    else:
        limits = [_joint_limit(model, joint) for joint in driven]
    missing = [int(driven[i]) for i, limit in enumerate(limits) if limit is None]
    if not missing:
        return limits, ""
    guess = float(f"{leg_torque(model):.3g}")
    names = [model.joint(j).name for j in missing]
    return [guess if limit is None else limit for limit in limits], (
        f"no torque limits of joints {listed(names)}: {guess:g} N m, the weight on one foot times "
        "the length of a leg; to say it yourself add forcerange to the actuators"
    )


def _changed_ranges(model, servos, driven) -> Iterator[str]:
    """What becomes of the control ranges, gears and torque limits of a file, for its notes."""
    if np.any(model.actuator_ctrllimited[servos]):
        yield "control ranges of the actuators are removed: joint limits and torque limits remain"
    geared = [i for i in range(model.nu) if model.actuator_gear[i, 0] != 1]
    if geared:
        yield (
            f"gears of actuators {listed([_actuator_name(model, i) for i in geared])} are "
            "multiplied into torque limits and gains, which are those of the joint"
        )
    low, high = model.actuator_forcerange.T
    uneven = (low != -high) & (model.actuator_forcelimited == 1)
    for found, rule in (
        (uneven & (low < 0), "are not symmetric: the smaller one holds in both directions"),
        (uneven & (low == 0), "are of one direction: the same is assumed for the other"),
    ):
        if found.any():
            names = listed(_actuator_name(model, i) for i in np.flatnonzero(found))
            yield f"torque limits of {names} {rule}"
    if np.any(model.jnt_actfrclimited[driven]):
        yield "torque limits of the joints (actuatorfrcrange, effort) are moved to the actuators"


def _hold_home(spec, model, driven):
    """Leave "home" as the only keyframe, with its joint positions as the targets of the servos."""
    for key in [key for key in spec.keys if key.name != "home"]:
        spec.delete(key)
    key = spec.key("home")
    key.act = []
    key.ctrl = home_qpos(model)[model.jnt_qposadr[driven]]


def _chosen_gains(model, gains) -> tuple[tuple[float, float], str]:
    """P and D gain of all servos from those of the file [n, 2], and a note if they differ."""
    different = np.unique(gains, axis=0)
    if len(different):
        p_gain, d_gain = np.median(gains, axis=0)
        if len(different) == 1:
            return (p_gain, d_gain), ""
        listing = ", ".join(f"{p:g}/{d:g}" for p, d in different)
        return (p_gain, d_gain), (
            f"{len(different)} different kp/kv ({listing}): the method has one pair for the whole "
            f"robot, the median {p_gain:g}/{d_gain:g}; to say it yourself use the same kp and kv "
            "everywhere"
        )
    mass = model.body_mass[1:].sum()
    usual = GAIN_PER_MASS * mass
    p_gain = float(np.round(np.clip(usual, *GAIN_RANGE)))
    d_gain = p_gain / GAIN_RATIO
    capped = ""
    if usual > GAIN_RANGE[1]:
        capped = (
            f" ({GAIN_PER_MASS:g} N m/rad per kg would be {usual:.0f}, but no more than "
            f"{GAIN_RANGE[1]:g} is inferred, as most heavy robots of the paper have it)"
        )
    return (p_gain, d_gain), (
        f"no gains: kp = {p_gain:g} N m/rad and kv = {d_gain:g} N m s/rad from the mass of "
        f"{mass:.3g} kg{capped}; to say it yourself give them in <position>"
    )


def _is_servo(model, i) -> bool:
    p_gain = model.actuator_gainprm[i, 0]
    return bool(
        model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED
        and model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE
        and model.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_NONE
        and p_gain > 0
        and model.actuator_biasprm[i, 1] == -p_gain
    )


def _gains(model, i) -> tuple[float, float]:
    """P and D gain at the joint."""
    square = model.actuator_gear[i, 0] ** 2
    return square * model.actuator_gainprm[i, 0], 0.0 - square * model.actuator_biasprm[i, 2]


def _torque_limit(model, i) -> float | None:
    """Smallest torque limit that the file gives for an actuator, at the joint, N m."""
    gear = abs(model.actuator_gear[i, 0])
    limits = [_joint_limit(model, model.actuator_trnid[i, 0])]
    if model.actuator_forcelimited[i]:
        limits.append(gear * _smaller(model.actuator_forcerange[i]))
    if (
        model.actuator_ctrllimited[i]
        and model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED
        and model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_NONE
    ):
        gain = abs(model.actuator_gainprm[i, 0])
        limits.append(gear * gain * _smaller(model.actuator_ctrlrange[i]))
    return min((limit for limit in limits if limit), default=None)


def _joint_limit(model, joint) -> float | None:
    if not model.jnt_actfrclimited[joint]:
        return None
    return _smaller(model.jnt_actfrcrange[joint]) or None


def _smaller(bounds) -> float:
    low, high = np.abs(bounds)
    return float(min(low, high) or max(low, high))


def leg_torque(model) -> float:
    """Weight on one foot times the length of a leg, N m.

    Its ratio to the torque limit of a robot's strongest leg joint has the median 1.1 over the 50
    robots of the paper, and is within a factor 2 for 86 %.
    """
    feet = foot_ids(model)
    gravity = np.linalg.norm(model.opt.gravity) or 9.81  # motors are chosen for the earth
    weight = model.body_mass[1:].sum() * gravity
    return float(weight * leg_length(model, feet) / max(1, len(feet)))


def _make_servo(actuator, joint, p_gain, d_gain, limit):
    actuator.trntype = _TRN.mjTRN_JOINT
    actuator.target = joint.name
    actuator.dyntype = mujoco.mjtDyn.mjDYN_NONE
    actuator.dynprm = [1] + [0] * (len(actuator.dynprm) - 1)
    actuator.actdim = -1
    actuator.set_to_position(kp=p_gain, kv=d_gain)
    actuator.gear = [1, 0, 0, 0, 0, 0]
    actuator.inheritrange = 0
    actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
    actuator.actlimited = mujoco.mjtLimited.mjLIMITED_FALSE
    actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
    actuator.forcerange = [-limit, limit]
    joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE


def _actuator_name(model, i: int) -> str:
    return model.actuator(i).name or model.joint(int(model.actuator_trnid[i, 0])).name
