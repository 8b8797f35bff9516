"""The standing test of a report: a second in the nominal pose, and the warnings it gives."""

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from shapebody.robot.geometry import lowest, posed
from shapebody.robot.robot import Robot
from shapebody.robot.servos import GAIN_PER_MASS, GAIN_RATIO
from shapebody.robot.spec_edits import listed

FLAT = 0.2  # how far legs reach down, as a share of their length; the 50 robots: above 0.36
SATURATED = 0.1  # share of the time at the torque limit above which a joint is named
CHATTER = 0.1  # share of the steps in which a torque reverses above which a joint is named
NOTABLE = 0.1  # of the torque limit: what counts as a torque when it reverses
SOFT = 0.5  # of `GAIN_PER_MASS`: below it a P gain is called low


@dataclass(frozen=True)
class Held:
    """The robot after some time in its nominal pose under its own gains."""

    finite: bool
    """False if the simulation failed."""
    sunk: float
    """How far the trunk sank, as a share of its height; above 1 if it fell through the floor."""
    tilt: float
    """Largest angle of the trunk from its home orientation, rad."""
    touching: np.ndarray
    """bool[nf], feet that touched the floor at some time."""
    saturated: np.ndarray
    """float[nu], share of the time at the torque limit; until it failed if it did."""
    reversing: np.ndarray
    """float[nu], share of the steps in which the torque changed its sign, both before and after
    it above `NOTABLE` of the limit."""

    @property
    def fell(self) -> bool:
        """Whether it left its nominal pose."""
        return self.tilt > np.radians(30) or self.sunk > 0.35


def hold(robot: Robot, seconds: float = 1.0) -> Held:
    """Simulate the nominal pose with constant targets in the C engine."""
    model, data = robot.model, mujoco.MjData(robot.model)
    data.qpos[:] = robot.home
    data.ctrl[:] = robot.nominal
    mujoco.mj_forward(model, data)
    height = max(data.xpos[robot.trunk, 2], 1e-3)
    up = data.xmat[robot.trunk].reshape(3, 3)[2].copy()
    least, angle = height, 0.0
    touching = np.zeros(robot.num_feet, bool)
    saturated = np.zeros(robot.num_actuators)
    reversing = np.zeros(robot.num_actuators)
    limits = model.actuator_forcerange[:, 1]
    before = np.zeros(robot.num_actuators)
    steps = max(1, round(seconds / model.opt.timestep))
    finite, done = True, 0
    for _ in range(steps):
        mujoco.mj_step(model, data)
        # MuJoCo resets what became unstable, and counts it.
        reset = any(data.warning[int(kind)].number for kind in _UNSTABLE)
        finite = not reset and bool(np.all(np.abs(data.qvel) < 1e4))  # false for NaN
        if not finite:
            break
        done += 1
        least = min(least, data.xpos[robot.trunk, 2])
        cosine = data.xmat[robot.trunk].reshape(3, 3)[2] @ up
        angle = max(angle, float(np.arccos(np.clip(cosine, -1, 1))))
        geoms = data.contact.geom[: data.ncon].ravel()
        touching |= np.isin(robot.feet, geoms)
        saturated += np.abs(data.actuator_force) >= 0.999 * limits
        share = data.actuator_force / limits
        reversing += (share * before < 0) & (np.minimum(abs(share), abs(before)) > NOTABLE)
        before = share
    done = max(1, done)
    return Held(
        finite, float(1 - least / height), angle, touching, saturated / done, reversing / done
    )


_UNSTABLE = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)


def steady_armature(model, p_gain: float, d_gain: float) -> float:
    """Inertia at a joint with which its servo is steady in steps of the simulation, kg m².

    With a velocity v and a position x relative to the target, a step does
    v -= (p_gain x + d_gain v) dt / I and x += v dt, which is stable up to twice
    (d_gain dt + p_gain dt²/2) / I = 1. Armature of that size suffices for all joints of a chain,
    since what else moves only adds to it.
    """
    step = model.opt.timestep
    return d_gain * step + p_gain * step**2 / 2


def leg_drop(robot: Robot) -> float:
    """How far the legs reach down in "home", as a share of their length: 1 hangs, 0 lies flat.

    From the first joint of a leg to the lowest point of its foot; of the leg that reaches furthest.
    """
    model, data = robot.model, posed(robot.model, robot.home)
    shares = []
    for foot, body in zip(robot.feet, robot.foot_bodies, strict=True):
        length = np.linalg.norm(model.geom_pos[foot])
        while model.body_parentid[body] > 0 and model.body_weldid[model.body_parentid[body]] != 1:
            length += np.linalg.norm(model.body_pos[body])
            body = model.body_parentid[body]
        shares.append((data.xpos[body, 2] - lowest(model, data, int(foot))) / max(length, 1e-9))
    return float(max(shares))


def warn_pose(robot: Robot, held: Held) -> Iterator[str]:
    """Do the legs reach down?"""
    drop = leg_drop(robot)
    if drop < FLAT:
        yield (
            f'it lies flat in "home": the legs reach down by {max(0, drop):.0%} of their length, '
            f"so the trunk is {robot.home[2]:.3g} m above the floor; give a pose with the feet "
            'below the trunk: <keyframe><key name="home" qpos="..."/></keyframe>, with the joints '
            "turned until the legs point down"
        )


def warn_standing(robot: Robot, held: Held) -> Iterator[str]:
    """Does it stand for a second?"""
    if not held.finite:
        light = _light_joints(robot)
        named = f" at {listed(light)}" if light else ""
        yield (
            "the simulation of the nominal pose becomes unstable within 1 s: the gains are too "
            f"high for the smallest inertias{named} (kp {robot.p_gain:g}, kv {robot.d_gain:g}); "
            f"lower them, or add armature to the joints: {_advised_armature(robot)} is enough"
        )
    elif held.fell and leg_drop(robot) >= FLAT:  # a robot that lies flat cannot fall
        if (held.reversing > CHATTER).any():
            cause = "Its torques chatter (see that warning), which may be why: correct that first"
        elif held.sunk > 1:
            cause = (
                "Only its feet touch the floor, so it fell over and the trunk went through: check "
                'that "home", the feet, kp and the torque limits are as intended'
            )
        else:
            cause = (
                "With gains as soft as the paper's that is usual (many of its robots fall, the "
                'Go2 among them) and the policy learns to hold it; but check that "home", kp and '
                "the torque limits are as intended"
            )
        sunk, tilt = min(held.sunk, 1.0), np.degrees(held.tilt)
        yield (
            f"it falls out of its nominal pose: within 1 s the trunk sinks by {sunk:.0%} of its "
            f"height and tilts by {tilt:.0f} degrees. {cause}"
        )
    if held.finite and not held.touching.all():
        feet = listed(robot.model.geom(int(i)).name for i in robot.feet[~held.touching])
        yield f'feet {feet} do not touch the floor in the nominal pose: correct "home" or the feet'


def _light_joints(robot: Robot) -> list[str]:
    """Names of the driven joints with too little inertia in "home" for their own servo."""
    model, data = robot.model, mujoco.MjData(robot.model)
    data.qpos[:] = robot.home
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    needed = steady_armature(model, robot.p_gain, robot.d_gain)
    mobility = np.diag(np.linalg.pinv(inertia))[robot.qvel_index]
    return [model.actuator(int(i)).name for i in np.flatnonzero(needed * mobility > 1)]


def _advised_armature(robot: Robot) -> str:
    needed = steady_armature(robot.model, robot.p_gain, robot.d_gain)
    digits = 10.0 ** (np.floor(np.log10(needed)) - 1)  # rounded up to two digits
    return f'armature="{np.ceil(needed / digits) * digits:.2g}" (kg m²)'


def warn_drives(robot: Robot, held: Held) -> Iterator[str]:
    """Do the drives hold the pose quietly and with torque to spare?"""
    if not held.finite:
        return
    model = robot.model
    chatters = held.reversing > CHATTER

    def shown(i: int) -> str:
        limit = f"{model.actuator_forcerange[i, 1]:.3g} N m"
        parts = [f"{held.reversing[i]:.0%} of the steps"] if chatters[i] else []
        if held.saturated[i] > SATURATED:
            parts.append(f"{held.saturated[i]:.0%} of the time at its limit of {limit}")
        return f"{model.actuator(i).name} ({', '.join(parts)})"

    shaking = ", ".join(shown(int(i)) for i in np.flatnonzero(chatters))
    if shaking:
        yield (
            "in the standing test the torque chatters, that is, it changes its sign from step to "
            f"step, at {shaking}: kp {robot.p_gain:g} and kv {robot.d_gain:g} are too high for the "
            "little inertia that these joints move, and the drives push back and forth instead of "
            f"holding; lower them, or add armature to the joints: {_advised_armature(robot)} is "
            "enough"
        )
    strained = (held.saturated > SATURATED) & ~chatters
    straining = ", ".join(shown(int(i)) for i in np.flatnonzero(strained))
    if straining:
        when = ", in which it falls," if held.fell else ""
        yield (
            f"in the standing test{when} the torque is at its limit at {straining}: nothing is "
            "left to hold the pose or to move; raise forcerange (in a URDF, effort) if the motor "
            'gives more, or correct "home" so that the weight is above the feet'
        )


def warn_gains(robot: Robot, held: Held) -> Iterator[str]:
    """Is P in proportion to the weight?"""
    mass = robot.model.body_mass[1:].sum()
    usual = GAIN_PER_MASS * mass
    if 0 < robot.p_gain < SOFT * usual:
        d_gain = usual / GAIN_RATIO
        needed = steady_armature(robot.model, usual, d_gain)
        yield (
            f"kp {robot.p_gain:g} N m/rad is low for {mass:.3g} kg: robots of the paper have about "
            f"{GAIN_PER_MASS:g} per kg, here {usual:.0f}, though its heaviest have 80 to 100 and "
            "the policy has to hold them. For a stiffer robot write "
            f'kp="{usual:.0f}" kv="{d_gain:.2g}" in every <position>, with armature of '
            f"{needed:.2g} kg m² or more"
        )
