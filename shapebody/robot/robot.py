"""A robot: a compiled MJCF file plus what the method reads from it.

A robot file is plain MJCF: one floating body, hinge joints with limits, position actuators, feet
that touch the floor, an IMU site and a "home" keyframe. What else an MJCF or URDF file lacks is
inferred from the rest of it (`shapebody.robot.completion`). All arrays of `Robot` are in MuJoCo's
order.
"""

import difflib
import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from shapebody.arguments import require_array, require_kind, require_path
from shapebody.arguments import shown as shortened
from shapebody.files import data_dir
from shapebody.robot.checks import CHECKS, check_feet, check_home, check_masses
from shapebody.robot.completion import complete
from shapebody.robot.entries import custom_numeric, custom_text, home_qpos
from shapebody.robot.feet import foot_ids
from shapebody.robot.finite import check_inertials, check_text
from shapebody.robot.guard import admit
from shapebody.robot.importing import read
from shapebody.robot.simulation import add_what_simulates, as_text, sensor_slices
from shapebody.robot.spec_edits import COLLISION_GROUP

_JOINT, _OBJ = mujoco.mjtJoint, mujoco.mjtObj


FOOT_SPHERE, FOOT_BOX = 0, 1

SUFFIXES = (".xml", ".urdf", ".mjcf")


def require_robot(robot) -> "Robot":
    """`robot` itself. Raises TypeError if it is not a `Robot`, but its name, for example."""
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
    anything, even if only sensors, foot-floor contacts or the targets of "home". Plain MuJoCo
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
        """Hinge joints."""
        return len(self.joints)

    @property
    def num_actuators(self) -> int:
        """Actuators, one for each driven joint."""
        return len(self.actuated)

    @property
    def num_feet(self) -> int:
        """Feet."""
        return len(self.feet)

    @property
    def num_spheres(self) -> int:
        """Collision spheres."""
        return len(self.spheres)

    @property
    def qpos_index(self) -> np.ndarray:
        """int[nu], addresses of the actuated joints in qpos."""
        return self.model.jnt_qposadr[self.joints[self.actuated]].astype(int)

    @property
    def qvel_index(self) -> np.ndarray:
        """int[nu], addresses of the actuated joints in qvel."""
        return self.model.jnt_dofadr[self.joints[self.actuated]].astype(int)

    def pose(self, nominal) -> np.ndarray:
        """float64[nq], the home pose with the actuated joints at `nominal` [nu], rad.

        Raises ValueError for another number of angles.
        """
        qpos = self.home.copy()
        qpos[self.qpos_index] = require_array("nominal", nominal, (self.num_actuators,))
        return qpos

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
    an existing file and not a shipped robot. What the file lacks is inferred where that is
    possible; `Robot.inferred` says what, and `shapebody.validate_robot` shows it.

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
    admit(path)
    text, spec, model, notes = read(path)

    # What cannot be inferred: with a problem here nothing can be completed.
    replaced = list(check_inertials(spec, model))
    checks = [check for check in CHECKS if not (replaced and check is check_masses)]
    problems = replaced + [message for check in checks for message in check(model)]
    problems = problems or list(check_text(text))
    if problems:
        return None, problems, tuple(notes)

    # What is missing and can be inferred, and what must hold for the result.
    added, model = complete(spec, model)
    notes += added
    problems = [message for check in (*CHECKS, check_feet, check_home) for message in check(model)]
    if problems:
        return None, problems, tuple(notes)

    # What plain MuJoCo needs. It follows from the rest of the file, so it needs no note.
    changed = add_what_simulates(spec, model)
    if changed:
        model = spec.compile()
    if changed or notes:
        text, model = as_text(spec, model)
    return _read(path.stem, path, text, model, tuple(notes)), [], tuple(notes)


def _read(name: str, path: Path | None, xml: str, model: mujoco.MjModel, inferred) -> Robot:
    joints = np.flatnonzero(model.jnt_type == _JOINT.mjJNT_HINGE)
    actuated = np.searchsorted(joints, model.actuator_trnid[:, 0])
    feet = foot_ids(model)
    home = home_qpos(model)
    keep = custom_numeric(model, "keep_nominal")
    legs = {2: "biped", 4: "quadruped", 6: "hexapod"}.get(len(feet), f"{len(feet)} feet")
    return Robot(
        name=name,
        display_name=custom_text(model, "display_name", name.replace("_", " ").title()),
        morphology=custom_text(model, "morphology", legs),
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
        velocity_limits=custom_numeric(model, "velocity_limits"),
        keep_nominal=np.zeros(model.nu, dtype=bool) if keep is None else keep == 1,
        p_gain=float(model.actuator_gainprm[0, 0]),
        d_gain=0.0 - float(model.actuator_biasprm[0, 2]),
        action_scale=float(custom_numeric(model, "action_scale")[0]),
        sensors=sensor_slices(model),
        inferred=inferred,
    )
