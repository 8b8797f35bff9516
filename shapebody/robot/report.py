"""What the method sees in a robot file: problems, what was inferred, and physical warnings."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np

from shapebody.arguments import require_output, require_path
from shapebody.files import atomic_write
from shapebody.robot.checks import tilt
from shapebody.robot.feet import ends_without_foot
from shapebody.robot.geometry import standing_pose
from shapebody.robot.home import FLOOR_TOLERANCE
from shapebody.robot.robot import Robot, examine, find
from shapebody.robot.servos import leg_torque
from shapebody.robot.spec_edits import comment, listed
from shapebody.robot.standing import (
    FLAT,
    Held,
    hold,
    leg_drop,
    warn_drives,
    warn_gains,
    warn_pose,
    warn_standing,
)

TILT = 15.0  # degrees of the trunk in "home" above which something is probably wrong
TURN = 2 * np.pi  # rad
RANGE_CHANGE = 0.8  # rad: in a design both limits of a joint can move towards each other by half


@dataclass(frozen=True, eq=False)
class Report:
    """Result of `validate_robot`; prints as text."""

    path: Path
    robot: Robot | None
    """The robot, or None if there are problems."""
    problems: tuple[str, ...]
    """Why the file cannot be used: value, what was expected, fix. As in errors of `load_robot`."""
    inferred: tuple[str, ...]
    """What the file lacks and what is assumed instead, with the way to say it in the file."""
    warnings: tuple[str, ...]
    """What can be used, but looks wrong or will cause trouble."""
    summary: dict[str, str] = field(default_factory=dict)
    """What the method sees, label -> value."""

    @property
    def ok(self) -> bool:
        """Whether the robot can be used."""
        return not self.problems

    def write(self, path: str | Path) -> Path:
        """Write the completed MJCF file, which needs nothing inferred and simulates in plain
        MuJoCo as the robot does here.

        Raises ValueError if there are problems, and for the path of the file itself.
        """
        if not self.ok:
            raise ValueError(
                f"{self.path} has {len(self.problems)} problems, so there is no completed file to "
                "write; correct them first"
            )
        path = require_output("path", path)
        itself = path.exists() and path.samefile(self.path)
        if itself and path.read_bytes().decode("utf-8-sig") != self.robot.xml:
            raise ValueError(
                f"{path} is the file itself, and the completed one has no meshes and other text: "
                "give another name"
            )
        notes = "".join(f"\n  - {note}" for note in self.inferred)
        head = comment(f"Completed from {self.path.name}:{notes}\n") + "\n" if notes else ""
        return atomic_write(path, head + self.robot.xml)

    def __str__(self) -> str:
        verdict = "can be used" if self.ok else "cannot be used yet"
        parts = [f"{self.path}: {verdict}"]
        if self.summary:
            width = max(map(len, self.summary))
            parts.append(
                "\n".join(f"  {label:{width}s}  {value}" for label, value in self.summary.items())
            )
        for title, items in (
            ("Problems", self.problems),
            ("Inferred", self.inferred),
            ("Warnings", self.warnings),
        ):
            if items:
                lines = [
                    textwrap.fill(
                        item,
                        width=98,
                        initial_indent="  - ",
                        subsequent_indent="    ",
                        break_on_hyphens=False,
                        break_long_words=False,
                    )
                    for item in items
                ]
                parts.append("\n".join([f"{title} ({len(items)})", *lines]))
        return "\n\n".join(parts)

    __repr__ = __str__


def validate_robot(name_or_path: str | Path) -> Report:
    """Report on a robot file (MJCF or URDF), or a robot of `robots()`.

    Everything that `load_robot` would raise for the file is a problem of the report. A value that
    can be neither a name nor a path raises TypeError or ValueError. Takes well under a second for a
    file without meshes.
    """
    path = require_path("robot", name_or_path)
    try:
        return _report(find(name_or_path))
    except (ValueError, OSError) as error:
        problem = str(error)
    except Exception as error:  # a report, whatever the file holds
        problem = (
            f"{path} cannot be judged, which is a fault of shapebody and not of the file: "
            f"{type(error).__name__}: {error}; please report it with the file"
        )
    return Report(path, None, (problem,), (), ())


def _report(path: Path) -> Report:
    robot, problems, inferred = examine(path)
    if robot is None:
        return Report(path, None, tuple(problems), inferred, ())
    held = hold(robot)
    warnings = [message for check in WARNINGS for message in check(robot, held)]
    return Report(path, robot, (), inferred, tuple(warnings), _summary(robot, held))


# Warnings. Each takes the robot and `Held` and yields one message per finding. More are in
# `shapebody.robot.standing`.


def warn_feet(robot: Robot, held: Held) -> Iterator[str]:
    """Are all feet found, and does every joint of a leg have a motor?"""
    model = robot.model
    ends = ends_without_foot(model, robot.home)
    if ends:
        bodies = listed(model.body(body).name for body in ends)
        named = [model.geom(group[0]).name for group in ends.values()]
        geoms = f" ({listed(named)})" if all(named) else ""
        yield (
            f"bodies {bodies} reach the floor like legs but have no foot, and only feet touch the "
            f'floor: if these are legs, put "foot" into the names of their lowest geoms{geoms} (in '
            'a URDF, fix a link with "foot" at the end of its name to each)'
        )
    if robot.num_feet < 2:
        yield (
            f"{robot.num_feet} foot ({model.geom(int(robot.feet[0])).name}): expected two or more; "
            'put "foot" into the name of every geom that touches the floor'
        )
    carrying = set()
    for body in robot.foot_bodies:
        while body > 0:
            carrying.add(int(body))
            body = model.body_parentid[body]
    free = np.setdiff1d(robot.joints, robot.joints[robot.actuated])
    free = [model.joint(int(j)).name for j in free if int(model.jnt_bodyid[j]) in carrying]
    if free:
        yield (
            f"joints {listed(free)} carry a foot but no actuator drives them: they swing freely; "
            "give each a <position>, or remove the <actuator> section to get one for every joint"
        )


def warn_torque(robot: Robot, held: Held) -> Iterator[str]:
    """Torque limits against the robot's own weight."""
    model, data = robot.model, mujoco.MjData(robot.model)
    data.qpos[:] = robot.home
    mujoco.mj_forward(model, data)
    weight = -model.body_mass[1:].sum() * model.opt.gravity / robot.num_feet
    needed = np.zeros(model.nv)
    for foot, body in zip(robot.feet, robot.foot_bodies, strict=True):
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, jacobian, None, data.geom_xpos[foot], int(body))
        needed += jacobian.T @ weight
    needed = np.abs(needed[robot.qvel_index])
    limits = model.actuator_forcerange[:, 1]
    weak = [
        f"{model.actuator(int(i)).name} (limit {limits[i]:.3g} N m, needs about {needed[i]:.3g})"
        for i in np.flatnonzero(needed > limits)
    ]
    if weak:
        yield f"too weak to stand with the weight on all feet: {listed(weak)}"
    usual = leg_torque(model)
    high = np.flatnonzero(limits > 20 * usual)
    if len(high):
        yield (
            f"torque limits of {listed(model.actuator(int(i)).name for i in high)} are up to "
            f"{limits.max():.3g} N m, over 20 times what a robot of this weight and leg length has "
            f"({usual:.3g} N m): a placeholder? Correct forcerange (in a URDF, effort)"
        )


def warn_friction(robot: Robot, held: Held) -> Iterator[str]:
    """Do the joints leave their motors enough torque to turn them?"""
    model = robot.model
    dof = robot.qvel_index
    lost = model.dof_frictionloss[dof] + model.dof_damping[dof]  # N m, at 1 rad/s
    limits = model.actuator_forcerange[:, 1]
    stuck = [
        f"{model.actuator(int(i)).name} ({lost[i]:.3g} of {limits[i]:.3g} N m)"
        for i in np.flatnonzero(lost > limits)
    ]
    if stuck:
        yield (
            "friction and damping take more torque at 1 rad/s than the motor has, so that it can "
            f"hardly turn the joint, at {listed(stuck)}: correct frictionloss, damping or the "
            "torque limits"
        )


def warn_limits(robot: Robot, held: Held) -> Iterator[str]:
    """Joint limits under design, and the nominal pose within them."""
    model = robot.model
    low, high = model.jnt_range[robot.joints].T
    narrow = [model.joint(int(j)).name for j in robot.joints[high - low < RANGE_CHANGE]]
    if narrow:
        degrees = (
            '. Are they in radians, which MJCF reads only with <compiler angle="radian"/>?'
            if (high - low).max() < np.radians(TURN)
            else ""
        )
        yield (
            f"joints {listed(narrow)} have ranges below {RANGE_CHANGE:g} rad: designs can make "
            f"their limits cross, which holds the joint about the middle{degrees}"
        )
    wide = [model.joint(int(j)).name for j in robot.joints[high - low > 3 * TURN]]
    if wide:
        yield (
            f"joints {listed(wide)} have ranges of up to {(high - low).max():.3g} rad, which is "
            f"{(high - low).max() / TURN:.3g} turns: are they in degrees? Expected radians (in a "
            'URDF, and in MJCF with <compiler angle="radian"/>)'
        )
    low, high = model.jnt_range[robot.joints[robot.actuated]].T
    outside = np.flatnonzero((robot.nominal < low) | (robot.nominal > high))
    if len(outside):
        names = listed(model.actuator(int(i)).name for i in outside)
        yield f'"home" is outside the joint limits at {names}: correct the keyframe or the range'
    middle, half = (high + low) / 2, 0.45 * (high - low)
    near = np.abs(robot.nominal - middle) > half + 1e-6
    near[outside] = False
    if near.any():
        names = listed(model.actuator(int(i)).name for i in np.flatnonzero(near))
        yield (
            f'"home" is in the outer 5 % of the range at {names}: designs clip nominal positions '
            "to the inner 90 %, the reference included"
        )


def warn_plausibility(robot: Robot, held: Held) -> Iterator[str]:
    """Pose of the trunk, sizes, gravity, damping, self-collision."""
    model = robot.model
    if tilt(robot.home) > TILT:
        yield (
            f'the trunk is tilted by {tilt(robot.home):.0f} degrees in "home": expected its frame '
            "with x forward and z up; turn the trunk frame until its z axis points up, or correct "
            "the quaternion (numbers 4 to 7 of qpos)"
        )
    mass, height = model.body_mass[1:].sum(), robot.home[2]
    lies = leg_drop(robot) < FLAT  # then its trunk is near the floor in any units
    if not 0.1 < mass < 300 or not (0.03 < height or lies) or height >= 3:
        yield f"{mass:.3g} kg and a trunk {height:.3g} m high: are the units kg and m?"
    if not np.allclose(model.opt.gravity, [0, 0, -9.81], atol=0.05):
        yield f"gravity is {model.opt.gravity}: expected 0 0 -9.81"
    if model.opt.density > 0 and model.opt.wind.any():
        yield f"wind is {model.opt.wind} m/s: expected none; remove it from <option>"
    light = [model.body(int(i)).name for i in np.flatnonzero(model.body_gravcomp)]
    if light:
        yield (
            f"gravity is compensated at bodies {listed(light)}: the legs carry less than their "
            "weight, which does not happen on a real robot; remove gravcomp"
        )
    gap = float(robot.home[2] - standing_pose(robot.model, robot.home, robot.feet)[2])
    if abs(gap) > FLOOR_TOLERANCE * height:
        yield f'the lowest foot of "home" is {gap:+.3f} m from the floor: correct the trunk height'
    if robot.d_gain == 0:
        yield (
            "the D gain (kv) is 0: the joints are damped by <joint damping> alone, and designs "
            "cannot change a D gain of 0; give kv"
        )
    if robot.num_spheres == 0:
        yield (
            "no collision spheres: self-collision is not penalized; add sphere geoms of group 5 "
            'where parts can meet, e.g. <geom type="sphere" size="0.05" group="5"/>'
        )


WARNINGS = (
    warn_pose,
    warn_standing,
    warn_drives,
    warn_gains,
    warn_feet,
    warn_torque,
    warn_friction,
    warn_limits,
    warn_plausibility,
)


def _summary(robot: Robot, held: Held) -> dict[str, str]:
    model = robot.model
    feet = [
        f"{model.geom(int(i)).name} ({'box' if kind else 'sphere'})"
        for i, kind in zip(robot.feet, robot.foot_types, strict=True)
    ]
    limits = model.actuator_forcerange[:, 1]

    def span(values, unit):
        low, high = values.min(), values.max()
        return f"{low:.3g} {unit}" if low == high else f"{low:.3g} to {high:.3g} {unit}"

    return {
        "robot": f"{robot.display_name} ({robot.morphology})",
        "bodies": f"{robot.num_bodies}, trunk {model.body(robot.trunk).name!r}",
        "joints": f"{robot.num_joints} hinges, {robot.num_actuators} driven, "
        f"{int(robot.keep_nominal.sum())} of them should keep their nominal position",
        "feet": f"{robot.num_feet}: {listed(feet)}",
        "mass": f"{model.body_mass[1:].sum():.4g} kg",
        "height": f"{robot.home[2]:.4g} m, trunk above the floor",
        "gains": f"kp {robot.p_gain:g} N m/rad, kv {robot.d_gain:g} N m s/rad, "
        f"action scale {robot.action_scale:g} rad",
        "torque limits": span(limits, "N m"),
        "velocity limits": span(robot.velocity_limits, "rad/s"),
        "standing": _standing(held),
        "design": f"d = {robot.design_dim} parameters",
    }


def _standing(held: Held) -> str:
    """What became of the robot in its nominal pose, in a few words."""
    if not held.finite:
        return "the simulation becomes unstable"
    tilt = f"tilted by {np.degrees(held.tilt):.0f} degrees"
    if held.sunk > 1:
        return f"falls over, {tilt} after 1 s (only feet touch the floor, so the trunk sinks in)"
    return f"after 1 s sunk by {max(0, held.sunk):.0%}, {tilt}"
