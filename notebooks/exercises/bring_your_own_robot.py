"""Exercises of 16_bring_your_own_robot."""

import mujoco
import numpy as np

from exercises import checker, need, same
from shapebody import validate_robot


@checker
def check_knee_torque(answer, robot):
    """Torque in N m at the last hinge of a leg, with the weight shared by all feet."""
    model, data = robot.model, mujoco.MjData(robot.model)
    data.qpos[:] = robot.home
    mujoco.mj_kinematics(model, data)
    reach = data.geom_xpos[robot.feet[0]] - data.xanchor[model.body_jntadr[robot.foot_bodies[0]]]
    torque = 9.81 * model.body_mass.sum() / robot.num_feet * np.hypot(*reach[:2])
    hint = "It is a quarter of the weight times the horizontal distance from knee to foot."
    need(same(abs(answer), torque, 0.05 * torque), hint)
    return f"{torque:.2f} N m; the motors have {model.actuator_forcerange[0, 1]:g} N m."


@checker
def check_twelve_motors(path):
    """The path of the Turtle with a third hinge of ±0.6 rad and its motor in each leg."""
    report = validate_robot(path)
    need(not report.problems, "".join(report.problems[:1]))
    motors, bodies = report.robot.num_actuators, report.robot.num_bodies
    need(motors == 12 and bodies == 9, f"It has {motors} motors and {bodies} bodies, not 12 and 9.")
    lifts = (np.abs(np.abs(report.robot.model.jnt_range) - 0.6) < 1e-3).all(1).sum()
    need(lifts == 4, f"{lifts} joints have the range ±0.6 rad, not 4.")
    left = [*report.inferred, *report.warnings, ""]
    need(len(left) == 1, f"The report still says: {left[0]}")
    return f"d = {report.robot.design_dim}: a hinge adds 11 parameters and its motor 3."
