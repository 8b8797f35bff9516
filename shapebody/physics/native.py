"""MuJoCo in C: many designs of one robot, stepped on a thread pool by `mujoco.batch`."""

from __future__ import annotations

import contextlib
import ctypes
import threading
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from shapebody.arguments import require_array, require_integer, require_kind
from shapebody.design.phi import MODEL_FIELDS, Embodiment
from shapebody.physics.protocol import (
    MAX_VALUE,
    MOST_SIMULATIONS,
    MOST_SUBSTEPS,
    EngineOutput,
    home_sensordata,
    prepare,
)

if TYPE_CHECKING:
    from shapebody.robot.robot import Robot

# In place of each of these, MuJoCo would reset the simulation or, for the last, drop the control.
_FATAL_WARNINGS = slice(
    int(mujoco.mjtWarning.mjWARN_BADQPOS), int(mujoco.mjtWarning.mjWARN_BADCTRL) + 1
)
_STATE = ("qpos", "qvel", "qacc_warmstart", "time")
_LARGEST = float(np.finfo(np.float32).max)  # sensor values are handed on in single precision


class NativePhysics:
    """N simulations of one robot, each with its own design.

    Constants that MuJoCo derives from a model (`body_invweight0`, `dof_invweight0`,
    `body_subtreemass`, ...) stay those of the reference, as in the paper's environment: they only
    make contacts and limits softer or stiffer. On the Go2, recomputing them for every design
    changed no return by more than 0.4 (data/results/derived_constants_go2.json).

    `qpos` (N, nq), `qvel` (N, nv) and `time` (N,) are live float64 arrays: what is written into
    them is the state from which the next `step` starts. All simulations begin with the reference
    design, at rest in the home pose.

    A simulation fails when MuJoCo raises an error in it, when a position, velocity or
    acceleration is not finite or exceeds 1e10, when a sensor value exceeds single precision, or
    when its control is invalid. It is then reported, put at rest in the home pose, and may go on
    from there; no other simulation notices. MuJoCo prints nothing about it: its log, to the
    console and to MUJOCO_LOG.TXT, is off while a step runs (for the whole process, since MuJoCo
    has only one log) and is restored after it.

    One instance must not be used from two Python threads at once; several instances may.

    Args:
      robot: the robot.
      num_envs: N, the number of simulations.
      threads: number of threads that step; 0 for one per CPU.
      substeps: physics steps per control step; 4 of 0.005 s make the paper's 50 Hz.
      solver_iterations: Newton iterations per physics step; None for MuJoCo's default.
      line_search: line-search steps per Newton iteration; None for MuJoCo's default.
    """

    def __init__(
        self,
        robot: Robot,
        num_envs: int,
        threads: int = 0,
        substeps: int = 4,
        solver_iterations: int | None = None,
        line_search: int | None = None,
    ):
        require_integer("threads (0: one per CPU)", threads, 0, 4096)
        self.robot = robot
        self.num_envs = require_integer("num_envs", num_envs, 1, MOST_SIMULATIONS)
        self.substeps = require_integer("substeps", substeps, 1, MOST_SUBSTEPS)
        self.model = prepare(robot, solver_iterations, line_search)
        self._home_sensordata = home_sensordata(robot, self.model)
        self._batch = Batch(self.model, self.num_envs, int(threads))
        self._fields = {name: self._batch.expand(name) for name in MODEL_FIELDS}
        self.qpos = self._batch.bind("qpos")
        self.qvel = self._batch.bind("qvel")
        self.time = self._batch.bind("time")
        self._warmstart = self._batch.bind("qacc_warmstart")
        self._ctrl = self._batch.bind("ctrl")
        self._sensordata = self._batch.bind("sensordata")
        self._warnings = self._batch.warning[:, _FATAL_WARNINGS, 1]
        self.set_state(np.arange(self.num_envs), robot.home, np.zeros(self.model.nv))

    @property
    def threads(self) -> int:
        """Number of threads that step, the calling one included."""
        return self._batch.nthread

    def set_designs(self, ids: np.ndarray, embodiments: Embodiment) -> None:
        """Give simulations new designs; their states stay as they are.

        Args:
          ids: (k,) distinct simulation numbers.
          embodiments: the designs in the same order; every model field has a leading axis k.

        Raises:
          ValueError: ids out of range, or a field of another shape.
        """
        ids = self._ids(ids)
        require_kind("embodiments", embodiments, Embodiment, "space(designs)")
        values = {}
        for name, field in self._fields.items():
            value = require_array(f"embodiments.{name}", getattr(embodiments, name), finite=False)
            if value.shape != (len(ids), *field.shape[1:]):
                raise ValueError(
                    f"embodiments.{name} has shape {value.shape}; {len(ids)} designs of "
                    f"{self.robot.name} need {(len(ids), *field.shape[1:])}"
                )
            values[name] = value
        for name, value in values.items():
            self._fields[name][ids] = value

    def set_state(self, ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Put simulations into given states, at time zero and with no memory of earlier ones.

        Args:
          ids: (k,) distinct simulation numbers.
          qpos: (k, nq), or (nq,) for all of them.
          qvel: (k, nv), or (nv,) for all of them.

        Raises:
          ValueError: ids out of range, or arrays of other shapes.
        """
        ids = self._ids(ids)
        self.qpos[ids] = self._broadcast("qpos", qpos, (len(ids), self.model.nq))
        self.qvel[ids] = self._broadcast("qvel", qvel, (len(ids), self.model.nv))
        self.time[ids] = 0.0
        self._warmstart[ids] = 0.0
        self._ctrl[ids] = self.robot.nominal

    def step(
        self,
        ctrl: np.ndarray,
        qpos: np.ndarray | None = None,
        qvel: np.ndarray | None = None,
        running: np.ndarray | None = None,
    ) -> EngineOutput:
        """Advance every simulation by one control step.

        Args:
          ctrl: (N, nu) target positions of the actuators in radians, held for all substeps.
          qpos: (N, nq) positions to start from instead of the present ones, or None.
          qvel: (N, nv) velocities to start from instead of the present ones, or None.
          running: (N,) bool, the simulations to advance; the others stay where they are, which
            costs nothing. None advances all.

        Returns:
          EngineOutput. `qpos`, `qvel` and `sensordata` are the live arrays, so copy what must
          survive the next call; `finite` is a new array.

        Raises:
          ValueError: arrays of other shapes.
        """
        ids = None  # all
        if running is not None:
            running = require_array("running", running, (self.num_envs,), kinds="b")
            ids = np.flatnonzero(running)
        self._write("ctrl", self._ctrl, ctrl)
        if qpos is not None:
            self._write("qpos", self.qpos, qpos)
        if qvel is not None:
            self._write("qvel", self.qvel, qvel)
        self._warnings[...] = 0
        finite = self._valid()
        with _silent_log():
            try:
                self._batch.step(ids=ids, nstep=self.substeps)
            except SimulationError as error:
                finite[error.ids] = False
        sensordata = self._sensordata
        finite &= self._valid() & ~self._warnings.any(1)
        finite &= (np.abs(sensordata) <= _LARGEST).all(1)  # also False for NaN
        if not finite.all():
            failed = np.flatnonzero(~finite)
            self.set_state(failed, self.robot.home, np.zeros(self.model.nv))
            sensordata = sensordata.copy()
            sensordata[failed] = self._home_sensordata
        return EngineOutput(self.qpos, self.qvel, sensordata, finite)

    def get_model(self, env: int) -> mujoco.MjModel:
        """A copy of the model that simulation `env` runs, with its design."""
        return self._batch.get_model(int(self._ids([require_integer("env", env)])[0]))

    def state(self) -> dict[str, np.ndarray]:
        """Copies of all arrays from which `restore` resumes exactly.

        Keys: qpos (N, nq), qvel (N, nv), qacc_warmstart (N, nv), time (N,), all float64. Designs
        are not part of it: give `set_designs` the same ones before resuming.
        """
        return {name: self._batch.bind(name).copy() for name in _STATE}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Resume from what `state` returned; the next steps are bitwise the same.

        Raises:
          ValueError: a missing array, or one of another shape.
        """
        require_kind("state", state, Mapping, "what state() returned")
        missing = [name for name in _STATE if name not in state]
        if missing:
            raise ValueError(f"the state lacks {', '.join(missing)}; use what state() returned")
        arrays = {name: require_array(name, state[name], finite=False) for name in _STATE}
        for name, array in arrays.items():
            live = self._batch.bind(name)
            if array.shape != live.shape:
                raise ValueError(
                    f"{name} has shape {array.shape}; this engine holds {live.shape}: create it "
                    "with the robot and the number of environments that were saved"
                )
        for name, array in arrays.items():
            self._batch.bind(name)[...] = array

    def _valid(self) -> np.ndarray:
        # A comparison instead of isfinite: it also catches what MuJoCo calls a huge value.
        state = (self.qpos, self.qvel)
        return np.logical_and(*((np.abs(x) <= MAX_VALUE).all(1) for x in state))

    def _ids(self, ids: np.ndarray) -> np.ndarray:
        ids = require_array("ids", ids)
        if ids.ndim != 1 or (ids.size and ids.dtype.kind not in "iu"):
            raise ValueError(
                f"ids has shape {ids.shape} and type {ids.dtype}; it must be a vector of integers "
                "(of a mask, pass numpy.flatnonzero(mask))"
            )
        if ids.size and (ids.min() < 0 or ids.max() >= self.num_envs):
            raise ValueError(
                f"ids reach from {ids.min()} to {ids.max()}; this engine has simulations "
                f"0 to {self.num_envs - 1}"
            )
        return ids.astype(np.int64, copy=False)

    def _write(self, name: str, live: np.ndarray, value: np.ndarray) -> None:
        value = require_array(name, value, finite=False)
        if value.shape != live.shape:
            raise ValueError(
                f"{name} has shape {value.shape}; {self.num_envs} simulations of "
                f"{self.robot.name} need {live.shape}"
            )
        live[...] = value

    def _broadcast(self, name: str, value: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        value = require_array(name, value, finite=False)
        if value.shape not in (shape, shape[1:]):
            raise ValueError(
                f"{name} has shape {value.shape}; {self.robot.name} needs {shape} or {shape[1:]}"
            )
        return value


class _LogConfig(ctypes.Structure):
    """The C structure mjLogConfig, for which MuJoCo's Python package has no accessors."""

    _fields_ = [
        ("logto_console", ctypes.c_bool),
        ("logto_file", ctypes.c_bool),
        ("logfile", ctypes.c_char * 1024),
        ("topics", ctypes.c_int),
    ]


def _log_functions():
    # The symbols are looked up through an extension module that links MuJoCo's own library, so
    # that no file name of that library has to be guessed.
    library = ctypes.CDLL(mujoco._functions.__file__)
    get, set_ = library.mju_getLogConfig, library.mju_setLogConfig
    get.argtypes, get.restype = [], _LogConfig
    set_.argtypes, set_.restype = [_LogConfig], None
    return get, set_


class _SilentLog:
    """Counts the steps in progress in all threads; the log is off while there are any."""

    def __init__(self):
        self._lock = threading.Lock()
        self._depth = 0
        self._saved = None
        try:
            self._get, self._set = _log_functions()
        except (AttributeError, OSError):
            # Where the symbols cannot be reached, failures are reported and also printed.
            self._get = self._set = None

    @contextlib.contextmanager
    def __call__(self) -> Iterator[None]:
        if self._get is None:
            yield
            return
        with self._lock:
            if self._depth == 0:
                self._saved, quiet = self._get(), self._get()
                quiet.logto_console = quiet.logto_file = False
                self._set(quiet)
            self._depth += 1
        try:
            yield
        finally:
            with self._lock:
                self._depth -= 1
                if self._depth == 0:
                    self._set(self._saved)


_silent_log = _SilentLog()
