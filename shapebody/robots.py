"""Robots: a compiled MJCF file plus what the method reads from it.

A robot file is plain MJCF: one floating body, hinge joints with limits, position actuators, feet
that touch the floor, an IMU site and a "home" keyframe. All arrays of `Robot` are in MuJoCo order.
"""

import difflib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from shapebody.paths import data_dir

COLLISION_GROUP = 5
FOOT_SPHERE, FOOT_BOX = 0, 1
PAIR_FRICTION = (1.0, 1.0, 0.005, 0.0001, 0.0001)

_OBJ, _JOINT, _SENSOR = mujoco.mjtObj, mujoco.mjtJoint, mujoco.mjtSensor


@dataclass(frozen=True, eq=False)
class Robot:
    """One robot, as loaded from its MJCF file. Arrays are NumPy; `model` must not be changed."""

    name: str
    display_name: str
    morphology: str
    path: Path | None
    xml: str
    """Text of the file."""
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
    """Load a robot by name (see `robots()`) or from an MJCF file.

    A string that ends in ".xml" and any Path is a file. Missing sensors and foot–floor contact
    pairs are added to the model; everything else must be in the file.

    Raises ValueError for an unknown name, for text that MuJoCo cannot compile and for a model that
    does not fit (every problem is listed); FileNotFoundError for a missing file.
    """
    path = _find(name_or_path)
    spec, model = _compile(path)
    problems = [message for check in CHECKS for message in check(model)]
    if problems:
        listing = "\n".join(f"  - {message}" for message in problems)
        raise ValueError(f"{path} cannot be used as a robot:\n{listing}")
    if _complete(spec, model):
        model = spec.compile()
    return _read(path.stem, path, path.read_text(encoding="utf-8"), model)


def _find(name_or_path: str | Path) -> Path:
    if not isinstance(name_or_path, str | Path):
        raise TypeError(
            f"load_robot expects a robot name or a path, got {type(name_or_path).__name__}"
        )
    if isinstance(name_or_path, Path) or name_or_path.endswith(".xml"):
        path = Path(name_or_path).expanduser()
        if not path.is_file():
            raise FileNotFoundError(
                f"robot file {str(name_or_path)!r} does not exist (looked at {path.absolute()}): "
                "give the path of an MJCF file, or one of the names of shapebody.robots()"
            )
        return path
    names = robots()
    if name_or_path not in names:
        close = difflib.get_close_matches(name_or_path, names, n=3, cutoff=0.5)
        hint = f" Did you mean {' or '.join(map(repr, close))}?" if close else ""
        raise ValueError(
            f"unknown robot {name_or_path!r}.{hint} Available robots: {', '.join(names) or 'none'}."
            " For a file of your own give its path, ending in '.xml'"
        )
    return data_dir() / "robots" / f"{name_or_path}.xml"


def _compile(path: Path) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        _name_parts(spec)
        return spec, spec.compile()
    except ValueError as error:
        raise ValueError(
            f"{path} is not a valid MJCF file: MuJoCo reports {str(error).strip()!r}. "
            "Expected a complete XML file with a <mujoco> root; correct the reported element"
        ) from error


def _name_parts(spec: mujoco.MjSpec) -> None:
    """Name what sensors refer to and MJCF leaves optional."""
    spheres = [geom for geom in spec.geoms if geom.group == COLLISION_GROUP]
    for index, geom in enumerate(spheres):
        geom.name = geom.name or f"sphere_{index}"
    for actuator in spec.actuators:
        actuator.name = actuator.name or actuator.target


# Checks. Each takes a compiled model and yields one message per problem: what, expected, fix.


def check_tree(model: mujoco.MjModel) -> Iterator[str]:
    """One floating body; every other body hangs from it."""
    free = np.flatnonzero(model.jnt_type == _JOINT.mjJNT_FREE)
    if len(free) == 0:
        yield (
            "no free joint: expected exactly one, in the trunk; "
            "add <freejoint/> to the first body of the worldbody"
        )
    elif len(free) > 1:
        bodies = ", ".join(_name(model, _OBJ.mjOBJ_BODY, model.jnt_bodyid[j]) for j in free)
        yield f"{len(free)} free joints (bodies {bodies}): expected exactly one; keep the trunk's"
    elif model.jnt_bodyid[free[0]] != 1:
        body = _name(model, _OBJ.mjOBJ_BODY, model.jnt_bodyid[free[0]])
        yield (
            f"the free joint is in body {body}: expected it in the first body; "
            "make the trunk the first body of the worldbody"
        )
    for body in range(2, model.nbody):
        if model.body_rootid[body] != 1 and model.body_parentid[body] == 0:
            yield (
                f"body {_name(model, _OBJ.mjOBJ_BODY, body)} is not part of the robot: "
                "expected one tree below the trunk; remove it or attach it"
            )


def check_joints(model: mujoco.MjModel) -> Iterator[str]:
    """Hinge joints with limits."""
    kinds = {_JOINT.mjJNT_BALL: "ball", _JOINT.mjJNT_SLIDE: "slide"}
    for joint in range(model.njnt):
        kind = mujoco.mjtJoint(model.jnt_type[joint])
        name = _name(model, _OBJ.mjOBJ_JOINT, joint)
        if kind in kinds:
            yield (
                f"joint {name} is a {kinds[kind]} joint: expected hinge joints only; "
                "replace it by hinges or remove it"
            )
        elif kind == _JOINT.mjJNT_HINGE and not (
            model.jnt_limited[joint] and model.jnt_range[joint, 0] < model.jnt_range[joint, 1]
        ):
            yield (
                f'joint {name} has no limits: expected range="lower upper" with lower < upper; '
                "add the range of the real joint"
            )


def check_actuators(model: mujoco.MjModel) -> Iterator[str]:
    """One position actuator with a torque limit per driven hinge joint."""
    if model.nu == 0:
        yield (
            "no actuators: expected one <position> actuator per driven joint; add an "
            "<actuator> section with joint, kp, kv and forcerange"
        )
    driven: dict[int, str] = {}
    for actuator in range(model.nu):
        name = _name(model, _OBJ.mjOBJ_ACTUATOR, actuator)
        joint = int(model.actuator_trnid[actuator, 0])
        if (
            model.actuator_trntype[actuator] != mujoco.mjtTrn.mjTRN_JOINT
            or model.jnt_type[joint] != _JOINT.mjJNT_HINGE
        ):
            yield (
                f'actuator {name} does not drive one hinge joint: expected joint="<hinge>"; '
                "replace tendon, site, body or free-joint transmissions"
            )
            continue
        if joint in driven:
            yield (
                f"actuators {driven[joint]} and {name} drive the same joint "
                f"{_name(model, _OBJ.mjOBJ_JOINT, joint)}: expected one per joint; remove one"
            )
        driven.setdefault(joint, name)
        p_gain = model.actuator_gainprm[actuator, 0]
        if (
            model.actuator_gaintype[actuator] != mujoco.mjtGain.mjGAIN_FIXED
            or model.actuator_biastype[actuator] != mujoco.mjtBias.mjBIAS_AFFINE
            or model.actuator_dyntype[actuator] != mujoco.mjtDyn.mjDYN_NONE
            or p_gain <= 0
            or model.actuator_biasprm[actuator, 1] != -p_gain
        ):
            yield (
                f"actuator {name} is not a position servo: expected "
                '<position kp="..." kv="..."/> with kp > 0; replace it'
            )
        low, high = model.actuator_forcerange[actuator]
        if not model.actuator_forcelimited[actuator] or not low == -high < 0:
            yield (
                f"actuator {name} has no symmetric torque limit: expected "
                'forcerange="-limit limit" in N m; add it'
            )
    gains = {(model.actuator_gainprm[i, 0], model.actuator_biasprm[i, 2]) for i in range(model.nu)}
    if len(gains) > 1:
        listing = ", ".join(f"{p:g}/{-d:g}" for p, d in sorted(gains))
        yield (
            f"actuators have {len(gains)} different kp/kv ({listing}): expected one P and one D "
            "gain for the whole robot; use the same kp and kv everywhere"
        )


def check_feet(model: mujoco.MjModel) -> Iterator[str]:
    """Sphere or box feet, and a floor below them."""
    feet = _foot_ids(model)
    if len(feet) == 0:
        yield (
            'no geom has "foot" in its name: expected one sphere or box per foot; '
            'name the geoms that touch the floor, e.g. name="left_foot"'
        )
    for geom in feet:
        kind = mujoco.mjtGeom(model.geom_type[geom])
        if kind not in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_BOX):
            yield (
                f"foot geom {_name(model, _OBJ.mjOBJ_GEOM, geom)} is a "
                f"{kind.name.removeprefix('mjGEOM_').lower()}: expected a sphere or a box; "
                'replace it by one of these (or take "foot" out of the name of a geom '
                "that is only for looks)"
            )
    floor = mujoco.mj_name2id(model, _OBJ.mjOBJ_GEOM, "floor")
    if floor < 0 or model.geom_type[floor] != mujoco.mjtGeom.mjGEOM_PLANE:
        yield (
            'no floor: expected a plane geom named "floor" in the worldbody; add '
            '<geom name="floor" type="plane" size="0 0 0.05" contype="0" conaffinity="0"/>'
        )


def check_spheres(model: mujoco.MjModel) -> Iterator[str]:
    """Geoms of group 5 are collision spheres."""
    for geom in np.flatnonzero(model.geom_group == COLLISION_GROUP):
        if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_SPHERE:
            yield (
                f"geom {_name(model, _OBJ.mjOBJ_GEOM, geom)} of group {COLLISION_GROUP} is not a "
                "sphere: that group is kept for collision spheres; use another group"
            )


def check_imu(model: mujoco.MjModel) -> Iterator[str]:
    """A site "imu" in the trunk."""
    site = mujoco.mj_name2id(model, _OBJ.mjOBJ_SITE, "imu")
    if site < 0:
        yield 'no site "imu": expected one in the trunk; add <site name="imu" pos="0 0 0"/>'
    elif model.site_bodyid[site] != 1:
        body = _name(model, _OBJ.mjOBJ_BODY, model.site_bodyid[site])
        yield f'site "imu" is in body {body}: expected it in the trunk (the first body); move it'


def check_home(model: mujoco.MjModel) -> Iterator[str]:
    """A keyframe "home", the nominal standing pose."""
    key = mujoco.mj_name2id(model, _OBJ.mjOBJ_KEY, "home")
    if key < 0:
        yield (
            'no keyframe "home": expected the nominal standing pose; add <keyframe><key '
            f'name="home" qpos="..."/></keyframe> with {model.nq} numbers'
        )


def check_custom(model: mujoco.MjModel) -> Iterator[str]:
    """Custom numbers: action scale, velocity limits and, optional, keep-nominal flags."""
    scale, speeds, keep = (
        _numeric(model, name) for name in ("action_scale", "velocity_limits", "keep_nominal")
    )
    if scale is None or scale.shape != (1,) or not scale[0] > 0:
        yield (
            f'custom numeric "action_scale" is {_shown(scale)}: expected one number > 0 (rad); '
            'add <custom><numeric name="action_scale" data="0.3"/></custom>'
        )
    if model.nu and (speeds is None or speeds.shape != (model.nu,) or not np.all(speeds > 0)):
        yield (
            f'custom numeric "velocity_limits" is {_shown(speeds)}: expected {model.nu} numbers '
            "> 0 (rad/s, one per actuator, in actuator order); add "
            '<custom><numeric name="velocity_limits" data="..."/></custom>'
        )
    if keep is not None and (keep.shape != (model.nu,) or not np.all((keep == 0) | (keep == 1))):
        yield (
            f'custom numeric "keep_nominal" is {_shown(keep)}: expected {model.nu} flags 0 or 1 '
            "(one per actuator); correct or remove it"
        )


CHECKS: tuple[Callable[[mujoco.MjModel], Iterator[str]], ...] = (
    check_tree,
    check_joints,
    check_actuators,
    check_feet,
    check_spheres,
    check_imu,
    check_home,
    check_custom,
)


def _name(model: mujoco.MjModel, kind: mujoco.mjtObj, index: int) -> str:
    return repr(mujoco.mj_id2name(model, kind, int(index)) or f"number {index}")


def _shown(values: np.ndarray | None) -> str:
    return "missing" if values is None else np.array2string(values, threshold=6)


def _foot_ids(model: mujoco.MjModel) -> np.ndarray:
    names = (mujoco.mj_id2name(model, _OBJ.mjOBJ_GEOM, i) or "" for i in range(model.ngeom))
    return np.array([i for i, name in enumerate(names) if "foot" in name.lower()], dtype=int)


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


# Sensors and contact pairs.


def _layout(model: mujoco.MjModel) -> dict[str, list[tuple]]:
    """Block name -> sensors (name, type, object type, object name) in order."""
    feet = [model.geom(i).name for i in _foot_ids(model)]
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


def _complete(spec: mujoco.MjSpec, model: mujoco.MjModel) -> bool:
    """Add missing sensors and foot–floor pairs to `spec`; says whether anything was added."""
    changed = False
    if _slices(model) is None:
        blocks = _layout(model)
        ours = {sensor[0] for sensors in blocks.values() for sensor in sensors}
        for sensor in [sensor for sensor in spec.sensors if sensor.name in ours]:
            spec.delete(sensor)
        for sensors in blocks.values():
            for name, kind, owner, target in sensors:
                spec.add_sensor(name=name, type=kind, objtype=owner, objname=target)
        changed = True
    floor = mujoco.mj_name2id(model, _OBJ.mjOBJ_GEOM, "floor")
    paired = {
        frozenset(pair)
        for pair in zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
    }
    for foot in _foot_ids(model):
        if frozenset((floor, int(foot))) not in paired:
            name = mujoco.mj_id2name(model, _OBJ.mjOBJ_GEOM, int(foot))
            spec.add_pair(geomname1="floor", geomname2=name, condim=3, friction=PAIR_FRICTION)
            changed = True
    return changed


def _read(name: str, path: Path | None, xml: str, model: mujoco.MjModel) -> Robot:
    joints = np.flatnonzero(model.jnt_type == _JOINT.mjJNT_HINGE)
    actuated = np.searchsorted(joints, model.actuator_trnid[:, 0])
    feet = _foot_ids(model)
    home = np.array(model.key_qpos[mujoco.mj_name2id(model, _OBJ.mjOBJ_KEY, "home")])
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
        d_gain=float(-model.actuator_biasprm[0, 2]),
        action_scale=float(_numeric(model, "action_scale")[0]),
        sensors=_slices(model),
    )
