"""What a robot file leaves out and can be inferred from the rest of it.

The method needs more than a simulation model says: which geoms are feet, a nominal pose, one pair
of gains, an action scale. `complete` adds what is missing to a file's spec, by the functions in
`STEPS`. Each takes the spec and its compiled model, changes the spec and yields one
note per change: what was missing, what is assumed, how to say it in the file. A file that needs
nothing gets no notes and stays as it is.
"""

import re
from collections.abc import Iterator

import mujoco
import numpy as np
from scipy.optimize import least_squares

from shapebody.feet import (
    colliding,
    foot_ids,
    foot_name,
    idle_tails,
    leg_ends,
    leg_length,
    lowest,
    lowest_geoms,
    sole_beside,
    solid,
    standing_height,
)
from shapebody.foot_shapes import FOOT_SHAPES, add_foot, is_tall, shape_name
from shapebody.reading import ARMATURE, IMU, VELOCITY_LIMIT
from shapebody.specs import (
    COLLISION_GROUP,
    FOOT,
    MESHES,
    add_floor,
    drop_assets,
    drop_geom,
    each,
    listed,
    ordered,
    rename_geom,
    rename_site,
    replace_geom,
    unused,
    write_inertial,
)

GAIN_PER_MASS = 1.5  # N m/rad per kg; the median of the 50 robots is 1.6
GAIN_RANGE = 20.0, 80.0  # N m/rad
GAIN_RATIO = 40.0  # 1/s, P over D gain
FLOOR_TOLERANCE = 0.05  # of the home height: how far feet may be from the floor

_GEOM, _JOINT, _TRN = mujoco.mjtGeom, mujoco.mjtJoint, mujoco.mjtTrn


def complete(spec: mujoco.MjSpec, model: mujoco.MjModel) -> list[str]:
    """Add to `spec` what the method needs; `model` is its compiled form. Returns the notes.

    The robot must be one floating tree of limited hinge joints (`robots.CHECKS`). What cannot be
    inferred (feet of a robot without geometry) is left out.
    """
    notes = []
    for step in STEPS:
        added = list(step(spec, model))
        if added:
            notes += added
            model = spec.compile()
    return notes


def infer_options(spec, model) -> Iterator[str]:
    """Physics settings: all robots are simulated alike, 5 ms per step.

    Gravity and the air are the file's own.
    """
    standard = mujoco.MjSpec().option
    standard.timestep = 0.005
    changed = []
    for name in (
        *("timestep", "integrator", "cone", "solver", "jacobian", "impratio"),
        *("iterations", "ls_iterations", "tolerance", "disableflags", "enableflags"),
    ):
        if getattr(spec.option, name) != getattr(standard, name):
            changed.append(f"{name} {getattr(spec.option, name):g}")
            setattr(spec.option, name, getattr(standard, name))
    if changed:
        yield (
            f"physics options {', '.join(changed)} differ from those of the method: replaced by "
            'its own, <option timestep="0.005"/> with MuJoCo\'s defaults'
        )


def infer_inertials(spec, model) -> Iterator[str]:
    """Inertials are written out where they depend on meshes or on settings of the compiler."""
    compiler, standard = spec.compiler, mujoco.MjSpec().compiler
    settings = [
        name
        for name in (
            *("inertiafromgeom", "boundmass", "boundinertia", "settotalmass", "balanceinertia"),
            *("fusestatic", "discardvisual"),
        )
        if getattr(compiler, name) != getattr(standard, name)
    ]
    inferred = []
    for body in spec.bodies[1:]:
        meshes = any(geom.meshname or geom.type in MESHES for geom in body.geoms)
        if settings or (meshes and not body.explicitinertial):
            inferred += [] if body.explicitinertial else [body.name]
            write_inertial(body, model)
    for name in settings:
        setattr(compiler, name, getattr(standard, name))
    if settings:
        yield f"compiler settings {listed(settings)} are applied once and written out as inertials"
    if inferred:
        yield (
            f"bodies {listed(inferred)} have no <inertial>: computed from their geoms, meshes "
            "included; to say it yourself add <inertial pos mass diaginertia> to the body"
        )


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


def infer_feet(spec, model) -> Iterator[str]:
    """One sphere or box per foot, with "foot" in its name and nothing else so named.

    Named geoms of other shapes are replaced by the sphere or box that bounds them, and named
    geoms that touch nothing by the colliding sole of the same leg, if it is as low. Without names,
    feet are the lowest geoms of the legs: of the outermost moving bodies that reach the floor in
    the home pose. Of geoms as tall as a shank the foot is the lower end.
    """
    geoms = {geom.id: geom for geom in spec.geoms}
    named: dict[int, list[int]] = {}
    for index, geom in geoms.items():
        if FOOT.search(geom.name) and geom.parent.name != "world":
            named.setdefault(int(model.geom_bodyid[index]), []).append(index)
    data = _home_data(model)
    tails, marked = [], []
    if named:
        groups, labels, marked = _named_feet(model, data, geoms, named)
    else:
        groups, tails = list(leg_ends(model, data.qpos).values()), idle_tails(model, data.qpos)
        labels = {group[0]: foot_name(geoms, group) for group in groups}
    own_names = {group[0] for group in named.values() if len(group) == 1}
    ready = {
        group[0]
        for group in groups
        if len(group) == 1
        and model.geom_type[group[0]] in FOOT_SHAPES
        and not geoms[group[0]].meshname
        and (group[0] in own_names or not is_tall(model, data, group))
    }
    if named and ready == own_names and len(ready) == len(named):
        return
    # A mesh that is only for looks must not count as a foot.
    for group in named.values():
        for index in group:
            names = {geom.name for geom in spec.geoms}
            rename_geom(spec, geoms[index], unused(FOOT.sub("sole", geoms[index].name), names))
    made = []
    for group in groups:
        geom = geoms[group[0]]
        body = geom.parent
        # The inertia of the body must not follow its new foot.
        if not body.explicitinertial:
            write_inertial(body, model)
        was = shape_name(model, group)
        if group[0] not in ready:
            if is_tall(model, data, group):
                was = f"the lower end of {was}"
            geom = add_foot(spec, geoms, model, data, group)
        rename_geom(spec, geom, unused(labels[group[0]], {other.name for other in spec.geoms}))
        shape = "sphere" if geom.type == _GEOM.mjGEOM_SPHERE else "box"
        made.append(f"{geom.name!r} (body {body.name!r}, {was}, now a {shape})")
    if not made:
        return
    if marked:
        yield (
            f"geoms {listed(marked)} touch nothing, and beside them other geoms of the same legs "
            f'do: these are the feet: {", ".join(made)}; to say it yourself put "foot" into the '
            "names of the geoms that touch the floor alone"
        )
    elif named:
        yield (
            f"feet must be one sphere or box each: {', '.join(made)}; to say it yourself replace "
            "the geoms"
        )
    else:
        yield (
            'no geom has "foot" in its name: the lowest geoms of the legs are the feet: '
            f"{', '.join(made)}; to say it yourself name the geoms that touch the floor, "
            'e.g. name="left_foot"'
        )
    if tails:
        yield (
            f"{each('body', [model.body(body).name for body in tails])} reaches the floor too, but "
            "is not like the legs, and the robot stands without it: it is a tail that bears no "
            'weight, and passes through the floor; to make it a foot put "foot" into the names of '
            "all geoms that touch the floor"
        )


def _named_feet(model, data, geoms, named):
    """Groups of geoms that are feet, the names of the feet by the first geom of a group, and the
    names of geoms that are no feet; `named` are the ids of named geoms by their bodies."""
    groups: dict[int, list[int]] = {}
    labels, marked = {}, []
    height = standing_height(model, data)
    for body, group in named.items():
        touching = colliding(model, group)
        level = data.geom_xpos[group, 2].min()
        sole = [] if touching else sole_beside(model, data, body, level)
        if sole:
            marked += [geoms[index].name for index in group]
        found = sole or lowest_geoms(model, data, solid(model, touching or group), height)
        # Two names for one sole are one foot.
        groups.setdefault(found[0], found)
        labels.setdefault(found[0], foot_name(geoms, group if sole else found))
    return list(groups.values()), labels, marked


def infer_height(spec, model) -> Iterator[str]:
    """The trunk in "home" so high that the lowest foot touches the floor."""
    feet = foot_ids(model)
    if len(feet) == 0:
        return
    data = _home_data(model)
    gap = min(lowest(model, data, foot) for foot in feet)
    height = data.xpos[1, 2] - gap
    if abs(gap) <= FLOOR_TOLERANCE * height:
        return
    key = spec.key("home")
    qpos = np.array(data.qpos)
    qpos[2] -= gap
    key.qpos = qpos
    side = "above" if gap > 0 else "below"
    yield (
        f'the feet of "home" are {abs(gap):.3f} m {side} the floor: the trunk is moved to z = '
        f"{qpos[2]:.4f} m; to say it yourself correct the third number of qpos"
    )


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
    joints = {joint.id: joint for joint in spec.joints}
    servos = [_is_servo(model, i) for i in range(model.nu)]
    gains = np.array([_gains(model, i) for i in range(model.nu) if servos[i]]).reshape(-1, 2)
    limits = [_torque_limit(model, i) for i in range(model.nu)]
    driven = model.actuator_trnid[:, 0] if model.nu else hinges
    fits = (
        model.nu > 0
        and all(servos)
        and len(np.unique(gains, axis=0)) == 1
        and np.all(model.actuator_trntype == _TRN.mjTRN_JOINT)
        and np.all(model.actuator_gear[:, 0] == 1)
        and np.all(model.actuator_forcelimited)
        and np.all(model.actuator_forcerange[:, 0] == -model.actuator_forcerange[:, 1])
        and not np.any(model.actuator_ctrllimited)
        and not np.any(model.jnt_actfrclimited[driven])
    )
    if fits:
        return
    if model.nu == 0:
        yield (
            f"no actuators: one position servo for each of the {len(hinges)} hinge joints; to say "
            "it yourself add an <actuator> section"
        )
        limits = [_joint_limit(model, j) for j in driven]
        for joint in driven:
            spec.add_actuator(name=joints[joint].name, target=joints[joint].name)
    elif not all(servos):
        others = [_actuator_name(model, i) for i in range(model.nu) if not servos[i]]
        yield (
            f"actuators {listed(others)} are motors or other drives: replaced by position "
            "servos, the form of control of the method; to say it yourself use <position>"
        )

    (p_gain, d_gain), note = _chosen_gains(model, gains)
    if note:
        yield note
    light = [
        int(driven[i])
        for i in range(len(driven))
        if not (model.nu and servos[i]) and model.dof_armature[model.jnt_dofadr[driven[i]]] == 0
    ]
    if light:
        for joint in light:
            joints[joint].armature = ARMATURE
        yield (
            f"no armature of joints {listed(model.joint(j).name for j in light)}: {ARMATURE:g} kg "
            "m², the inertia of a motor as the joint feels it; to say it yourself add "
            f'armature="{ARMATURE:g}" to the joints'
        )

    missing = [int(driven[i]) for i, limit in enumerate(limits) if limit is None]
    if missing:
        guess = float(f"{leg_torque(model):.3g}")
        names = [model.joint(j).name for j in missing]
        yield (
            f"no torque limits of joints {listed(names)}: {guess:g} N m, the weight on one foot "
            "times the length of a leg; to say it yourself add forcerange to the actuators"
        )
        limits = [guess if limit is None else limit for limit in limits]
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

    for actuator, joint, limit in zip(ordered(spec.actuators), driven, limits, strict=True):
        _make_servo(actuator, joints[int(joint)], p_gain, d_gain, limit)
    home = np.array(model.key_qpos[_home_id(model)])
    for key in [key for key in spec.keys if key.name != "home"]:
        spec.delete(key)
    key = spec.key("home")
    key.act = []
    key.ctrl = home[model.jnt_qposadr[driven]]


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


def drop_meshes(spec, model) -> Iterator[str]:
    """Meshes, height fields and image files are dropped; the file then stands by itself."""
    fitted = [geom for geom in spec.geoms if geom.meshname and geom.type not in MESHES]
    for geom in fitted:  # primitives whose size the compiler takes from a mesh
        size, position = model.geom_size[geom.id], model.geom_pos[geom.id]
        replace_geom(spec, geom, geom.type, size, position, model.geom_quat[geom.id])
    meshes = [geom for geom in spec.geoms if geom.type in MESHES]
    bodies = [geom.parent for geom in meshes]
    for geom in meshes:
        drop_geom(spec, geom)
    assets = drop_assets(spec)
    # What the meshes hid is now all that can be seen.
    for body in bodies:
        if body.name != "world" and not any(geom.group <= 2 for geom in body.geoms):
            for geom in body.geoms:
                geom.group = geom.group if geom.group == COLLISION_GROUP else 2
    if meshes or assets:
        yield (
            f"{len(meshes)} mesh geoms and {assets} mesh, height field or texture assets are "
            "dropped: the method does not use them, and looks come from the primitives"
        )


def infer_contacts(spec, model) -> Iterator[str]:
    """Only feet meet the floor; all other contacts are switched off."""
    colliding = [geom for geom in spec.geoms if geom.contype or geom.conaffinity]
    for geom in colliding:
        geom.contype = geom.conaffinity = 0
    pairs = [
        pair
        for pair in spec.pairs
        if not any(
            floor == "floor" and FOOT.search(foot)
            for floor, foot in (
                (pair.geomname1, pair.geomname2),
                (pair.geomname2, pair.geomname1),
            )
        )
    ]
    excludes = list(spec.excludes)
    for element in (*pairs, *excludes):
        spec.delete(element)
    if colliding or pairs or excludes:
        yield (
            f"contacts of {len(colliding)} geoms, {len(pairs)} contact pairs and {len(excludes)} "
            "excludes are removed: in the method only feet touch, and only the floor; the geoms "
            f"stay for looks. Give spheres group {COLLISION_GROUP} to penalize self-collision"
        )


def infer_floor(spec, model) -> Iterator[str]:
    """A plane geom "floor" at z = 0."""
    level = dict(position=[0, 0, 0], quaternion=[1, 0, 0, 0])
    planes = [geom for geom in spec.worldbody.geoms if geom.type == _GEOM.mjGEOM_PLANE]
    for geom in (geom for geom in planes if geom.name == "floor"):
        height, normal = model.geom_pos[geom.id, 2], np.zeros(3)
        mujoco.mju_rotVecQuat(normal, np.array([0.0, 0, 1]), model.geom_quat[geom.id])
        tilt = np.degrees(np.arccos(np.clip(normal[2], -1, 1)))
        if abs(height) > 1e-6 or tilt > 0.01:
            replace_geom(spec, geom, geom.type, geom.size, **level)
            yield (
                f'the plane "floor" is at z = {height:g} m and tilted by {tilt:.3g} degrees: the '
                "method walks on level ground at z = 0, and the plane is put there; to say it "
                "yourself remove its position and orientation"
            )
        return
    for geom in spec.geoms:
        if geom.name == "floor":
            rename_geom(spec, geom, unused("ground", {other.name for other in spec.geoms}))
    if planes:
        was = planes[0].name
        rename_geom(spec, planes[0], "floor")
        replace_geom(spec, planes[0], planes[0].type, planes[0].size, **level)
        yield f'no geom "floor": the plane {was!r} is the floor; to say it yourself rename it'
    else:
        yield add_floor(spec)


def infer_imu(spec, model) -> Iterator[str]:
    """A site "imu" in the trunk."""
    sites = [site for site in ordered(spec.sites) if IMU.search(site.name)]
    trunk = [site for site in sites if model.site_bodyid[site.id] == 1]
    if any(site.name == "imu" for site in trunk):
        return
    for site in sites:
        if site.name == "imu":  # of another body
            rename_site(spec, site, unused(f"imu_{site.parent.name}", {s.name for s in sites}))
    if trunk:
        was = trunk[0].name
        rename_site(spec, trunk[0], "imu")
        yield f'no site "imu": site {was!r} is the IMU; to say it yourself rename it'
    else:
        spec.bodies[1].add_site(name="imu")
        where = f" (not in body {sites[0].parent.name!r})" if sites else ""
        yield (
            f'no site "imu" in the trunk{where}: the IMU is at the origin of the trunk; to say it '
            'yourself add <site name="imu" pos="0 0 0"/> to the trunk'
        )


def infer_action_scale(spec, model) -> Iterator[str]:
    """0.25 rad on four feet under 25 kg, 0.75 rad on two feet over 40 kg, else 0.5 rad.

    This is exactly the paper's value for 74 % of its 50 robots, and within a factor 2 for 96 %.
    """
    if _has_numeric(model, "action_scale"):
        return
    mass, feet = model.body_mass[1:].sum(), len(foot_ids(model))
    scale = 0.25 if feet == 4 and mass < 25 else 0.75 if feet == 2 and mass > 40 else 0.5
    spec.add_numeric(name="action_scale", data=[scale], size=1)
    yield (
        f"no action scale: {scale:g} rad, as robots of {feet} feet and {mass:.3g} kg have it; to "
        f'say it yourself add <custom><numeric name="action_scale" data="{scale:g}"/></custom>'
    )


def infer_velocity_limits(spec, model) -> Iterator[str]:
    """15 rad/s: within a factor 2 of the median joint for 62 % of the 50 robots."""
    if _has_numeric(model, "velocity_limits") or model.nu == 0:
        return
    spec.add_numeric(name="velocity_limits", data=[VELOCITY_LIMIT] * model.nu, size=model.nu)
    yield (
        f"no velocity limits: {VELOCITY_LIMIT:g} rad/s for each of the {model.nu} actuators; to "
        'say it yourself add <custom><numeric name="velocity_limits" data="..."/></custom>'
    )


def infer_keep_nominal(spec, model) -> Iterator[str]:
    """Driven joints that carry no foot (arms, head) should keep their nominal positions.

    For 47 of the 50 robots of the paper these are exactly the joints that it keeps.
    """
    if _has_numeric(model, "keep_nominal"):
        return
    carrying = set()
    for foot in foot_ids(model):
        body = int(model.geom_bodyid[foot])
        while body > 0:
            carrying.add(body)
            body = int(model.body_parentid[body])
    driven = model.actuator_trnid[:, 0]
    keep = [float(int(model.jnt_bodyid[joint]) not in carrying) for joint in driven]
    if not carrying or not any(keep):
        return
    spec.add_numeric(name="keep_nominal", data=keep, size=model.nu)
    names = [model.joint(int(j)).name for j, kept in zip(driven, keep, strict=True) if kept]
    yield (
        f"joints {listed(names)} carry no foot: they should keep their nominal positions; to say "
        'it yourself add <custom><numeric name="keep_nominal" data="..."/></custom>, 0 or 1 each'
    )


def drop_tendons(spec, model) -> Iterator[str]:
    """Tendons that nothing drives are dropped."""
    if not spec.tendons:
        return
    names = {tendon.name for tendon in spec.tendons}
    for sensor in [s for s in spec.sensors if s.objtype == mujoco.mjtObj.mjOBJ_TENDON]:
        spec.delete(sensor)
    for tendon in list(spec.tendons):
        spec.delete(tendon)
    yield (
        f"tendons {listed(sorted(names))} are dropped, with their springs and limits: the design "
        "of the robot has no parameters for them"
    )


STEPS = (
    infer_options,
    infer_inertials,
    drop_tendons,
    infer_home,
    infer_feet,
    infer_height,
    infer_actuators,
    drop_meshes,
    infer_floor,
    infer_contacts,
    infer_imu,
    infer_action_scale,
    infer_velocity_limits,
    infer_keep_nominal,
)


def _home_id(model) -> int:
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home")


def _home_data(model) -> mujoco.MjData:
    """Positions of all parts in the home pose."""
    data = mujoco.MjData(model)
    data.qpos[:] = model.key_qpos[_home_id(model)]
    mujoco.mj_kinematics(model, data)
    return data


def _has_numeric(model, name: str) -> bool:
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, name) >= 0


def _actuator_name(model, i: int) -> str:
    return model.actuator(i).name or model.joint(int(model.actuator_trnid[i, 0])).name
