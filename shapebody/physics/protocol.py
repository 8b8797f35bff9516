"""Two physics engines behind one small protocol.

Both engines simulate one robot in a batch of environments, each with its own design:

* `shapebody.physics.native.NativePhysics`: MuJoCo in C on a thread pool, float64, stateful;
* `shapebody.physics.mjx.MjxPhysics`: MJX, float32, functional and traceable by JAX.

For the same design, state and control they return the same readings: positions, velocities, the
vector of the robot's sensors, and whether the simulation is still finite. The sensors describe the
state before the last of the physics steps that make up one control step, as MuJoCo defines it.
The modules import their engine, so this package imports neither until a class is asked for.
"""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import mujoco
import numpy as np

from shapebody.arguments import require_integer
from shapebody.robot.robot import Robot, require_robot

MOST_SIMULATIONS, MOST_SUBSTEPS = 2**20, 10_000

MAX_VALUE = 1e10
"""Largest magnitude of a position, velocity or acceleration that MuJoCo takes for a valid one."""


class EngineOutput(NamedTuple):
    """What an engine returns for N environments after a control step.

    A simulation that failed has `finite` False, the home pose, zero velocity and the sensors of
    the reference design resting there: values that are harmless to compute with, to be discarded.
    """

    qpos: Any
    """(N, nq): free joint first (metres, unit quaternion w x y z), then hinges in radians."""
    qvel: Any
    """(N, nv): metres per second and radians per second."""
    sensordata: Any
    """(N, nsensordata): in the order of the robot's sensors, one physics step old."""
    finite: Any
    """(N,) bool: False where the simulation became invalid during this control step."""


def prepare(
    robot: Robot, solver_iterations: int | None = None, line_search: int | None = None
) -> mujoco.MjModel:
    """Return the copy of the robot's model on which an engine runs designs.

    The compiler marks frames that coincide at the reference and then skips their transforms. A
    design moves these frames, so the marks are cleared. The automatic reset of invalid states is
    switched off, because it would hide them.

    Args:
      robot: the robot; its own model is not changed.
      solver_iterations: Newton iterations per physics step, or None for the model's number.
      line_search: line-search steps per Newton iteration, or None for the model's number.

    Raises:
      ValueError: a body whose mass matrix the compiler fixed to be diagonal.
    """
    model = copy.copy(require_robot(robot).model)
    if model.dof_simplenum.any():
        body = mujoco.mj_id2name(
            model, mujoco.mjtObj.mjOBJ_BODY, model.dof_bodyid[model.dof_simplenum.argmax()]
        )
        raise ValueError(
            f"{robot.name}: body {body!r} is a single rigid body, whose mass matrix MuJoCo keeps "
            "diagonal at compile time; designs that move its centre of mass would be simulated "
            "wrongly. Give the body a jointed child in the MJCF file"
        )
    same = mujoco.mjtSameFrame
    # The world's flag stays: it never moves, and engines skip it.
    model.body_sameframe[1:] = same.mjSAMEFRAME_NONE
    # Designs move geoms and sites but do not turn them within their body, so where the
    # orientation is the body's own, that part of the mark stays true and saves time.
    for flags in (model.geom_sameframe, model.site_sameframe):
        with_body = (flags == same.mjSAMEFRAME_BODY) | (flags == same.mjSAMEFRAME_BODYROT)
        flags[:] = np.where(with_body, same.mjSAMEFRAME_BODYROT, same.mjSAMEFRAME_NONE)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    if solver_iterations is not None:
        model.opt.iterations = require_integer("solver_iterations", solver_iterations, 1, 10_000)
    if line_search is not None:
        model.opt.ls_iterations = require_integer("line_search", line_search, 1, 10_000)
    return model


def home_sensordata(robot: Robot, model: mujoco.MjModel) -> np.ndarray:
    """Sensors (nsensordata,) of the reference design at rest in its home pose."""
    data = mujoco.MjData(model)
    data.qpos[:] = robot.home
    data.ctrl[:] = robot.nominal
    mujoco.mj_forward(model, data)
    return data.sensordata.copy()
