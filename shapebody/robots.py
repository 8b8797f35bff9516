"""Robots: a compiled MJCF file plus what the method reads from it.

A robot file is plain MJCF: one floating body, hinge joints with limits, position actuators, feet
that touch the floor, an IMU site and a "home" keyframe. What else an MJCF or URDF file lacks is
inferred from the rest of it (`shapebody.inference`). All arrays of `Robot` are in MuJoCo order.
"""

import difflib
import hashlib
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from shapebody.checks import require_kind, require_path
from shapebody.checks import shown as shortened
from shapebody.feet import ends_without_foot, foot_ids, lowest, standing_height
from shapebody.finite import check_inertials, check_numbers, check_text, is_finite
from shapebody.inference import complete
from shapebody.paths import data_dir
from shapebody.reading import read
from shapebody.specs import COLLISION_GROUP, each, keep_inertias_writable, listed

FOOT_SPHERE, FOOT_BOX = 0, 1
PAIR_FRICTION = (1.0, 1.0, 0.005, 0.0001, 0.0001)
SUFFIXES = (".xml", ".urdf", ".mjcf")
MIN_MASS, MIN_INERTIA = 1e-7, 1e-11  # kg, kg m²; those of real robots are above 1e-6 and 1e-10
FAR = 1e4  # m and rad: no robot is there
MAX_TILT = 45.0  # degrees of the trunk in "home"

_OBJ, _JOINT, _SENSOR = mujoco.mjtObj, mujoco.mjtJoint, mujoco.mjtSensor


def require_robot(robot) -> "Robot":
    """The argument; TypeError if it is no Robot, such as a name."""
    require_kind("robot", robot, Robot, f"load it with shapebody.load_robot({shortened(robot)})")
    return robot


@dataclass(frozen=True, eq=False)
class Robot:
    """One robot, as loaded from its MJCF file. Arrays are NumPy; `model` must not be changed."""

    name: str
    display_name: str
    morphology: str
    path: Path | None
    xml: str
    """MJCF text that stands by itself: that of the file, or the completed one if the file lacks
    anything, be it only sensors, foot-floor contacts or the targets of "home". Plain MuJoCo
    simulates it as the method does. Loaded again, it gives the same robot with nothing inferred."""
    model: mujoco.MjModel
    joints: np.ndarray
    """int[nj], MuJoCo ids of the hinge joints (all but the free joint)."""
    actuated: np.ndarray
    """int[nu], index into `joints` of the joint of each actuator."""
    feet: np.ndarray
    """int[nf], geom ids."""
    foot_bodies: np.ndarray
    """int[nf], body ids."""
    foot_types: np.ndarray
    """int[nf], 0 sphere, 1 box."""
    spheres: np.ndarray
    """int[ns], geom ids of the spheres used for self-collision checks."""
    imu_site: int
    trunk: int
    floor: int
    nominal: np.ndarray
    """float64[nu], home positions of the actuated joints, rad."""
    home: np.ndarray
    """float64[nq], the home keyframe."""
    velocity_limits: np.ndarray
    """float64[nu], rad/s."""
    keep_nominal: np.ndarray
    """bool[nu], joints that should stay at their nominal position (arms, head, waist)."""
    p_gain: float
    d_gain: float
    action_scale: float
    sensors: dict[str, slice]
    """Slices of `sensordata`: imu_angular_velocity, imu_linear_velocity, imu_position,
    imu_orientation, foot_positions, foot_orientations, foot_velocities, sphere_positions,
    actuator_forces."""
    inferred: tuple[str, ...] = ()
    """What the file lacked and what is assumed instead, one sentence each."""

    @property
    def hash(self) -> str:
        """First 16 hexadecimal digits of the SHA-256 of `xml`."""
        return hashlib.sha256(self.xml.encode()).hexdigest()[:16]

    @property
    def num_bodies(self) -> int:
        """Bodies without the world."""
        return self.model.nbody - 1

    @property
    def num_joints(self) -> int:
        return len(self.joints)

    @property
    def num_actuators(self) -> int:
        return len(self.actuated)

    @property
    def num_feet(self) -> int:
        return len(self.feet)

    @property
    def num_spheres(self) -> int:
        return len(self.spheres)

    @property
    def qpos_index(self) -> np.ndarray:
        """int[nu], addresses of the actuated joints in qpos."""
        return self.model.jnt_qposadr[self.joints[self.actuated]].astype(int)

    @property
    def qvel_index(self) -> np.ndarray:
        """int[nu], addresses of the actuated joints in qvel."""
        return self.model.jnt_dofadr[self.joints[self.actuated]].astype(int)

    @property
    def design_dim(self) -> int:
        """Length d of the design vector, 9 + 13 nb + 11 nj + 3 nu + 3 nf."""
        return (
            9
            + 13 * self.num_bodies
            + 11 * self.num_joints
            + 3 * self.num_actuators
            + 3 * self.num_feet
        )

    def __repr__(self) -> str:
        return (
            f"Robot({self.name!r}, {self.morphology}, {self.num_actuators} actuators, "
            f"{self.num_feet} feet, d={self.design_dim})"
        )


def robots() -> list[str]:
    """Names of the shipped robots, sorted."""
    return sorted(path.stem for path in (data_dir() / "robots").glob("*.xml"))


def load_robot(name_or_path: str | Path) -> Robot:
    """Load a robot by name (see `robots()`) or from an MJCF or URDF file.

    Any Path is a file, and so is a string that ends in ".xml" or ".urdf", contains a "/", or names
    an existing file but no shipped robot. What the file lacks is inferred where that is possible;
    `Robot.inferred` says what, and `shapebody.validate_robot` shows it.

    Raises ValueError for an unknown name, for text that MuJoCo cannot compile and for a model that
    does not fit (every problem is listed); FileNotFoundError for a missing file.
    """
    path = find(name_or_path)
    robot, problems, _ = examine(path)
    if problems:
        listing = "\n".join(f"  - {message}" for message in problems)
        raise ValueError(f"{path} cannot be used as a robot:\n{listing}")
    return robot


def find(name_or_path: str | Path) -> Path:
    """The file of a robot given by name or path. Raises as `load_robot`."""
    path = require_path("robot", name_or_path)
    text = str(name_or_path)
    looks_like_a_path = "/" in text or os.sep in text or text.lower().endswith(SUFFIXES)
    if isinstance(name_or_path, str) and not looks_like_a_path:
        names = robots()
        if text in names:
            return data_dir() / "robots" / f"{text}.xml"
        if not os.path.exists(text):
            close = difflib.get_close_matches(text[:100], names, n=3, cutoff=0.5)
            hint = f" Did you mean {' or '.join(map(repr, close))}?" if close else ""
            raise ValueError(
                f"unknown robot {shortened(text)}.{hint} "
                f"Available robots: {', '.join(names) or 'none'}. "
                "For a file of your own give its path, e.g. 'my_robot.xml' or 'my_robot.urdf'"
            )
    if path.is_dir():
        files = sorted(f.name for f in path.iterdir() if f.suffix.lower() in SUFFIXES)
        inside = f"one of its files: {', '.join(files[:8])}" if files else "an MJCF file"
        raise ValueError(f"{path} is a folder: expected a file; give the path of {inside}")
    if not path.is_file():
        raise FileNotFoundError(
            f"robot file {shortened(text)} does not exist (looked at {path.absolute()}): "
            "give the path of an MJCF or URDF file, or one of the names of shapebody.robots()"
        )
    return path


def examine(path: Path) -> tuple[Robot | None, list[str], tuple[str, ...]]:
    """Robot of a file (None if there are problems), problems, and what was inferred.

    Raises ValueError for a file that MuJoCo cannot compile.
    """
    text, spec, model, notes = read(path)
    replaced = list(check_inertials(spec, model))
    checks = [check for check in CHECKS if not (replaced and check is check_masses)]
    problems = replaced + [message for check in checks for message in check(model)]
    problems = problems or list(check_text(text))
    if problems:
        return None, problems, tuple(notes)
    notes += complete(spec, model)
    if notes:
        model = spec.compile()
    problems = [message for check in (*CHECKS, check_feet, check_home) for message in check(model)]
    if problems:
        return None, problems, tuple(notes)
    # What this adds follows from the rest of the file, so it needs no note.
    if _add_what_simulates(spec, model) or notes:
        text, model = _written(spec)
    return _read(path.stem, path, text, model, tuple(notes)), [], tuple(notes)


# Checks. Each takes a compiled model and yields one message per problem: what, expected, fix.
# They judge what cannot be inferred; what is merely missing is no problem.


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
                f'{each("joint", names)} has range="{finding}", which is no limit: expected lower '
                '< upper and no limited="false"; correct the range (in a URDF, lower and upper of '
                "<limit>)"
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
            # What is below 1e-9 is what `read` put in place of nothing.
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
    """Feet at the ends of legs. Asked of the completed model."""
    feet = foot_ids(model)
    fixed = [foot for foot in feet if model.body_weldid[model.geom_bodyid[foot]] == 1]
    if fixed:
        names = [_name(model, _OBJ.mjOBJ_GEOM, foot) for foot in fixed]
        bodies = [_name(model, _OBJ.mjOBJ_BODY, b) for b in ends_without_foot(model, _home(model))]
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
            f"{each('geom', names)} is a foot and a collision sphere of group {COLLISION_GROUP}: "
            "expected one or the other; use another group for the foot"
        )
    if len(feet) == 0:
        yield (
            'no geom has "foot" in its name, and no leg ends in a geom that could be a foot: '
            "expected one sphere or box per foot; add them where the robot touches the floor, e.g. "
            '<geom name="left_foot" type="sphere" size="0.02" pos="0 0 -0.2"/>'
        )


def check_home(model: mujoco.MjModel) -> Iterator[str]:
    """A trunk with z up, above the feet, in "home". Asked of the completed model."""
    feet, trunk = foot_ids(model), _name(model, _OBJ.mjOBJ_BODY, 1)
    if len(feet) == 0:
        return
    data = mujoco.MjData(model)
    data.qpos[:] = _home(model)
    mujoco.mj_kinematics(model, data)
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
    """Positions of keyframes that a robot can have: larger ones leave no digits for the feet."""
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
    """Ranges of torques that a motor can have: both directions, or at least none in between."""
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
        _numeric(model, name) for name in ("action_scale", "velocity_limits", "keep_nominal")
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


def _home(model: mujoco.MjModel) -> np.ndarray:
    return np.array(model.key_qpos[mujoco.mj_name2id(model, _OBJ.mjOBJ_KEY, "home")])


def _shown(values: np.ndarray) -> str:
    return np.array2string(values, threshold=6)


def _numeric(model: mujoco.MjModel, name: str) -> np.ndarray | None:
    index = mujoco.mj_name2id(model, _OBJ.mjOBJ_NUMERIC, name)
    if index < 0:
        return None
    start = model.numeric_adr[index]
    return np.array(model.numeric_data[start : start + model.numeric_size[index]])


def _text(model: mujoco.MjModel, name: str, default: str) -> str:
    index = mujoco.mj_name2id(model, _OBJ.mjOBJ_TEXT, name)
    if index < 0:
        return default
    start = model.text_adr[index]
    return bytes(model.text_data[start : start + model.text_size[index]]).decode().rstrip("\0")


# What plain MuJoCo needs: sensors, contact pairs, the state "home".


def _layout(model: mujoco.MjModel) -> dict[str, list[tuple]]:
    """Block name -> sensors (name, type, object type, object name) in order."""
    feet = [model.geom(i).name for i in foot_ids(model)]
    spheres = [model.geom(i).name for i in np.flatnonzero(model.geom_group == COLLISION_GROUP)]
    actuators = [model.actuator(i).name for i in range(model.nu)]
    imu = {
        "imu_angular_velocity": _SENSOR.mjSENS_GYRO,
        "imu_linear_velocity": _SENSOR.mjSENS_VELOCIMETER,
        "imu_position": _SENSOR.mjSENS_FRAMEPOS,
        "imu_orientation": _SENSOR.mjSENS_FRAMEQUAT,
    }
    blocks = {name: [(name, kind, _OBJ.mjOBJ_SITE, "imu")] for name, kind in imu.items()}
    for block, suffix, kind, names, owner in (
        ("foot_positions", "position", _SENSOR.mjSENS_FRAMEPOS, feet, _OBJ.mjOBJ_GEOM),
        ("foot_orientations", "orientation", _SENSOR.mjSENS_FRAMEQUAT, feet, _OBJ.mjOBJ_GEOM),
        ("foot_velocities", "velocity", _SENSOR.mjSENS_FRAMELINVEL, feet, _OBJ.mjOBJ_GEOM),
        ("sphere_positions", "position", _SENSOR.mjSENS_FRAMEPOS, spheres, _OBJ.mjOBJ_GEOM),
        ("actuator_forces", "force", _SENSOR.mjSENS_ACTUATORFRC, actuators, _OBJ.mjOBJ_ACTUATOR),
    ):
        blocks[block] = [(f"{name}_{suffix}", kind, owner, name) for name in names]
    return blocks


def _slices(model: mujoco.MjModel) -> dict[str, slice] | None:
    """Slice of sensordata of each block, or None if a block is missing or out of order."""
    slices = {}
    for block, sensors in _layout(model).items():
        ids = [mujoco.mj_name2id(model, _OBJ.mjOBJ_SENSOR, sensor[0]) for sensor in sensors]
        for index, (_, kind, owner, target) in zip(ids, sensors, strict=True):
            if (
                index < 0
                or model.sensor_type[index] != kind
                or model.sensor_objtype[index] != owner
                or model.sensor_objid[index] != mujoco.mj_name2id(model, owner, target)
                or model.sensor_refid[index] >= 0
            ):
                return None
        if ids and ids != list(range(ids[0], ids[0] + len(ids))):
            return None
        start = int(model.sensor_adr[ids[0]]) if ids else 0
        slices[block] = slice(start, start + int(sum(model.sensor_dim[i] for i in ids)))
    return slices


def _add_what_simulates(spec: mujoco.MjSpec, model: mujoco.MjModel) -> bool:
    """Add to `spec` the missing sensors and foot-floor pairs, and let "home" be a state at rest
    whose targets are its joint positions; says whether anything was changed.

    With it, the file alone simulates in MuJoCo as the robot does here.
    """
    return any([_add_sensors(spec, model), _add_pairs(spec, model), _rest_home(spec, model)])


def _add_sensors(spec: mujoco.MjSpec, model: mujoco.MjModel) -> bool:
    if _slices(model) is not None:
        return False
    blocks = _layout(model)
    ours = {sensor[0] for sensors in blocks.values() for sensor in sensors}
    for sensor in [sensor for sensor in spec.sensors if sensor.name in ours]:
        spec.delete(sensor)
    for sensors in blocks.values():
        for name, kind, owner, target in sensors:
            spec.add_sensor(name=name, type=kind, objtype=owner, objname=target)
    return True


def _add_pairs(spec: mujoco.MjSpec, model: mujoco.MjModel) -> bool:
    floor = mujoco.mj_name2id(model, _OBJ.mjOBJ_GEOM, "floor")
    paired = {
        frozenset(pair)
        for pair in zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
    }
    missing = [foot for foot in foot_ids(model) if frozenset((floor, int(foot))) not in paired]
    for foot in missing:
        name = mujoco.mj_id2name(model, _OBJ.mjOBJ_GEOM, int(foot))
        spec.add_pair(geomname1="floor", geomname2=name, condim=3, friction=PAIR_FRICTION)
    return len(missing) > 0


def _rest_home(spec: mujoco.MjSpec, model: mujoco.MjModel) -> bool:
    index = mujoco.mj_name2id(model, _OBJ.mjOBJ_KEY, "home")
    targets = _home(model)[model.jnt_qposadr[model.actuator_trnid[:, 0]]]
    if (
        np.array_equal(model.key_ctrl[index], targets)
        and not model.key_qvel[index].any()
        and model.key_time[index] == 0
    ):
        return False
    key = spec.key("home")
    key.time, key.qvel, key.ctrl = 0, np.zeros(model.nv), targets
    return True


def _written(spec: mujoco.MjSpec) -> tuple[str, mujoco.MjModel]:
    """Text of `spec`, and the model that this text compiles to, to the last digit."""
    keep_inertias_writable(spec, spec.compile())
    text = spec.to_xml()
    return text, mujoco.MjModel.from_xml_string(text)


def _read(name: str, path: Path | None, xml: str, model: mujoco.MjModel, inferred) -> Robot:
    joints = np.flatnonzero(model.jnt_type == _JOINT.mjJNT_HINGE)
    actuated = np.searchsorted(joints, model.actuator_trnid[:, 0])
    feet = foot_ids(model)
    home = _home(model)
    keep = _numeric(model, "keep_nominal")
    legs = {2: "biped", 4: "quadruped", 6: "hexapod"}.get(len(feet), f"{len(feet)} feet")
    return Robot(
        name=name,
        display_name=_text(model, "display_name", name.replace("_", " ").title()),
        morphology=_text(model, "morphology", legs),
        path=path,
        xml=xml,
        model=model,
        joints=joints,
        actuated=actuated,
        feet=feet,
        foot_bodies=model.geom_bodyid[feet].astype(int),
        foot_types=np.where(
            model.geom_type[feet] == mujoco.mjtGeom.mjGEOM_BOX, FOOT_BOX, FOOT_SPHERE
        ),
        spheres=np.flatnonzero(model.geom_group == COLLISION_GROUP),
        imu_site=mujoco.mj_name2id(model, _OBJ.mjOBJ_SITE, "imu"),
        trunk=1,
        floor=mujoco.mj_name2id(model, _OBJ.mjOBJ_GEOM, "floor"),
        nominal=home[model.jnt_qposadr[joints[actuated]]],
        home=home,
        velocity_limits=_numeric(model, "velocity_limits"),
        keep_nominal=np.zeros(model.nu, dtype=bool) if keep is None else keep == 1,
        p_gain=float(model.actuator_gainprm[0, 0]),
        d_gain=0.0 - float(model.actuator_biasprm[0, 2]),
        action_scale=float(_numeric(model, "action_scale")[0]),
        sensors=_slices(model),
        inferred=inferred,
    )
