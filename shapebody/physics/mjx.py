"""MJX: many designs of one robot as functions that JAX compiles, for an accelerator.

Differences from C MuJoCo that remain at equal solver settings: single precision, another line
search, and only the nearer of a joint's two limits acting where a design puts them in reverse
order.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from shapebody.arguments import (
    require_array,
    require_integer,
    require_kind,
    require_shape,
    single,
)
from shapebody.design.phi import MODEL_FIELDS, Embodiment
from shapebody.physics.protocol import (
    MAX_VALUE,
    MOST_SIMULATIONS,
    MOST_SUBSTEPS,
    home_sensordata,
    prepare,
)

with contextlib.redirect_stdout(io.StringIO()):  # It prints that the optional Warp is missing.
    from mujoco import mjx
    from mujoco.mjx._src import collision_driver, math

if TYPE_CHECKING:
    from shapebody.robot.robot import Robot

# MJX decides once, for all designs, which joints have dry friction, and its solver locks such a
# joint in a design whose friction is zero. So all hinges have some, far below what matters.
_LEAST_FRICTION = 1e-9


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PhysicsState:
    """The state of N simulations, from which `MjxPhysics.step` continues exactly."""

    design: dict[str, jax.Array]
    """Model fields of each simulation's design, each with a leading axis N."""
    qpos: jax.Array
    """(N, nq)"""
    qvel: jax.Array
    """(N, nv)"""
    qacc_warmstart: jax.Array
    """(N, nv) accelerations from which the constraint solver starts."""


class MjxPhysics:
    """N simulations of one robot, each with its own design. All methods can be jitted.

    The readings are those of `shapebody.physics.native.NativePhysics`, in JAX's default precision:
    a simulation whose positions, velocities, accelerations or controls are not finite, or exceed
    1e10, is reported and put at rest in the home pose inside the compiled step. Constants that
    MuJoCo derives from a model stay those of the reference.

    Args:
      robot: the robot.
      num_envs: N, the number of simulations.
      substeps: physics steps per control step; 4 of 0.005 s make the paper's 50 Hz.
      solver_iterations: Newton iterations per physics step.
      line_search: line-search steps per Newton iteration.
    """

    def __init__(
        self,
        robot: Robot,
        num_envs: int,
        substeps: int = 4,
        solver_iterations: int = 4,
        line_search: int = 8,
    ):
        self.robot = robot
        self.num_envs = require_integer("num_envs", num_envs, 1, MOST_SIMULATIONS)
        self.substeps = require_integer("substeps", substeps, 1, MOST_SUBSTEPS)
        model = prepare(robot, solver_iterations, line_search)
        # MJX has no automatic reset that could be switched off.
        model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self._home_sensordata = home_sensordata(robot, model)
        self._hinge_dofs = model.jnt_type[model.dof_jntid] == mujoco.mjtJoint.mjJNT_HINGE
        model.dof_frictionloss[self._hinge_dofs] = 1.0
        self.model = model
        self._mjx_model = mjx.put_model(model, impl="jax")
        self._mjx_data = mjx.make_data(model, impl="jax")

    def init(self, embodiments: Embodiment, qpos: jax.Array, qvel: jax.Array) -> PhysicsState:
        """Start all simulations.

        Args:
          embodiments: N designs; every model field has a leading axis N.
          qpos: (N, nq), or (nq,) for all of them.
          qvel: (N, nv), or (nv,) for all of them.

        Raises:
          ValueError: a field or an array of another shape.
        """
        require_kind("embodiments", embodiments, Embodiment, "space(designs)")
        design = {}
        for name in MODEL_FIELDS:
            value = require_shape(f"embodiments.{name}", getattr(embodiments, name), None)
            value = jnp.asarray(value)
            expected = (self.num_envs, *getattr(self.model, name).shape)
            if value.shape != expected:
                raise ValueError(
                    f"embodiments.{name} has shape {value.shape}; {self.num_envs} designs of "
                    f"{self.robot.name} need {expected}"
                )
            design[name] = value.astype(getattr(self._mjx_model, name).dtype)
        friction = design["dof_frictionloss"]
        least = np.where(self._hinge_dofs, _LEAST_FRICTION, 0.0).astype(friction.dtype)
        design["dof_frictionloss"] = jnp.maximum(friction, least)
        qvel = self._broadcast("qvel", qvel, self.model.nv)
        return PhysicsState(
            design=design,
            qpos=self._broadcast("qpos", qpos, self.model.nq),
            qvel=qvel,
            qacc_warmstart=jnp.zeros_like(qvel),
        )

    def reset(
        self,
        state: PhysicsState,
        mask: jax.Array,
        embodiments: Embodiment,
        qpos: jax.Array,
        qvel: jax.Array,
    ) -> PhysicsState:
        """Restart the simulations of `mask` (N,) bool; the arguments are those of `init`.

        The values given for the other simulations are computed with but not used.
        """
        _require_state(state)
        if not isinstance(mask, jax.Array):
            mask = require_array("mask", mask, kinds="b")
        mask = jnp.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ValueError(
                f"mask has shape {mask.shape} and type {mask.dtype}; it must be a boolean vector "
                f"of {self.num_envs} entries"
            )
        return _where(mask, self.init(embodiments, qpos, qvel), state)

    def velocity(self, state: PhysicsState) -> jax.Array:
        """Generalized velocities (N, nv)."""
        _require_state(state)
        return state.qvel

    def with_velocity(self, state: PhysicsState, qvel: jax.Array) -> PhysicsState:
        """The state with other generalized velocities (N, nv)."""
        _require_state(state)
        return dataclasses.replace(state, qvel=self._broadcast("qvel", qvel, self.model.nv))

    def step(
        self, state: PhysicsState, ctrl: jax.Array
    ) -> tuple[PhysicsState, jax.Array, jax.Array, jax.Array, jax.Array]:
        """Advance every simulation by one control step.

        Args:
          state: from `init`, `reset` or an earlier step.
          ctrl: (N, nu) target positions of the actuators in radians, held for all substeps.

        Returns:
          (state, qpos (N, nq), qvel (N, nv), sensordata (N, nsensordata), finite (N,) bool), the
          last four as in `shapebody.physics.protocol.EngineOutput`.

        Raises:
          ValueError: ctrl of another shape.
        """
        _require_state(state)
        if require_shape("ctrl", ctrl, None).shape != (self.num_envs, self.model.nu):
            raise ValueError(
                f"ctrl has shape {ctrl.shape}; {self.num_envs} simulations of {self.robot.name} "
                f"need {(self.num_envs, self.model.nu)}"
            )
        qpos, qvel, warmstart, sensordata, finite = jax.vmap(self._advance)(
            state.design, state.qpos, state.qvel, state.qacc_warmstart, ctrl
        )
        after = dataclasses.replace(state, qpos=qpos, qvel=qvel, qacc_warmstart=warmstart)
        home = dataclasses.replace(
            state,
            qpos=jnp.broadcast_to(jnp.asarray(self.robot.home, qpos.dtype), qpos.shape),
            qvel=jnp.zeros_like(qvel),
            qacc_warmstart=jnp.zeros_like(warmstart),
        )
        after = _where(finite, after, home)
        resting = jnp.asarray(self._home_sensordata, sensordata.dtype)
        sensordata = jnp.where(finite[:, None], sensordata, resting)
        return after, after.qpos, after.qvel, sensordata, finite

    def _advance(self, design, qpos, qvel, warmstart, ctrl):
        model = self._mjx_model.tree_replace(design)

        def substep(carry, _):
            qpos, qvel, warmstart, _, finite = carry
            data = self._mjx_data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart, ctrl=ctrl)
            with _box_contacts_as_in_c():
                data = mjx.step(model, data)
            finite &= _valid(data.qacc) & _valid(data.qpos) & _valid(data.qvel)
            finite &= jnp.all(jnp.isfinite(data.sensordata))
            return (data.qpos, data.qvel, data.qacc_warmstart, data.sensordata, finite), None

        finite = _valid(qpos) & _valid(qvel) & _valid(ctrl)
        carry = (qpos, qvel, warmstart, self._mjx_data.sensordata, finite)
        carry, _ = jax.lax.scan(substep, carry, length=self.substeps)
        return carry

    def _broadcast(self, name: str, value: jax.Array, size: int) -> jax.Array:
        if not isinstance(value, jax.Array):
            value = single(require_array(name, value, finite=False))
        value = jnp.asarray(value, self._mjx_data.qpos.dtype)
        if value.shape not in ((self.num_envs, size), (size,)):
            raise ValueError(
                f"{name} has shape {value.shape}; {self.robot.name} needs "
                f"{(self.num_envs, size)} or {(size,)}"
            )
        return jnp.broadcast_to(value, (self.num_envs, size))


def _plane_box(model, data, key, geoms):
    """Contacts of boxes with planes: the four lowest corners of each box, as in C MuJoCo.

    MJX's own function leaves out corners more than 1 mm above the lowest one, so that a foot
    which lands at an angle would be pushed up at one edge only.
    """
    del key
    plane, box = geoms.T
    normal = data.geom_xmat[plane][:, :, 2]
    signs = jnp.array(list(itertools.product((-1.0, 1.0), repeat=3)), data.qpos.dtype)
    local = signs * model.geom_size[box][:, None]
    corners = data.geom_xpos[box][:, None] + jnp.einsum("bij,bcj->bci", data.geom_xmat[box], local)
    height = jnp.einsum("bci,bi->bc", corners - data.geom_xpos[plane][:, None], normal)
    depth, lowest = jax.lax.top_k(-height, _plane_box.ncon)
    corners = jnp.take_along_axis(corners, lowest[:, :, None], axis=1)
    middle = corners + 0.5 * depth[:, :, None] * normal[:, None]
    frames = jnp.repeat(jax.vmap(math.make_frame)(normal), _plane_box.ncon, axis=0)
    return -depth.reshape(-1), middle.reshape(-1, 3), frames


_plane_box.ncon = 4


@contextlib.contextmanager
def _box_contacts_as_in_c():
    # MJX has no public way to replace a collision function; this holds while JAX traces a step.
    functions, key = collision_driver._COLLISION_FUNC, (mjx.GeomType.PLANE, mjx.GeomType.BOX)
    original, functions[key] = functions[key], _plane_box
    try:
        yield
    finally:
        functions[key] = original


def _valid(values: jax.Array) -> jax.Array:
    # False for NaN and infinity too.
    return jnp.all(jnp.abs(values) <= MAX_VALUE)


def _where(mask: jax.Array, new: Any, old: Any) -> Any:
    def choose(x, y):
        return jnp.where(mask.reshape(mask.shape + (1,) * (x.ndim - 1)), x, y)

    return jax.tree.map(choose, new, old)


def _require_state(state) -> None:
    require_kind("state", state, PhysicsState, "what init, reset or step returned")
