"""The locomotion environment: episodes of `episode` on one of two physics engines.

`Locomotion` is what the rest of the package uses. The loops are elsewhere, one for each engine:
`native_rollout` alternates compiled task code with one threaded call of C MuJoCo, `mjx_rollout`
compiles a whole rollout. Environments of several robots share one `batch`.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from shapebody.arguments import (
    refuse,
    require_array,
    require_flag,
    require_function,
    require_integer,
    require_key,
    require_kind,
    require_list,
    single,
)
from shapebody.design.descriptions import Descriptions, Sizes
from shapebody.physics.engine import resolved, simulator
from shapebody.robot.robot import Robot, require_robot
from shapebody.task import mjx_rollout, native_rollout
from shapebody.task.batch import Batch, RobotGroup
from shapebody.task.config import TaskConfig
from shapebody.task.episode import Episode, Outcome
from shapebody.task.randomization import draw_designs
from shapebody.task.trajectory import PolicyFunction, StepRecord, Trajectory

MOST_ENVIRONMENTS = 2**20
"""Largest batch."""

START_SETTINGS = ("horizon", "command", "initial", "action_delay", "delay", "mixed_delay")
"""Beginnings of the names of those fields of TaskConfig that the start of an episode depends on."""


class Locomotion:
    """A batch of environments of one or more robots.

    Args:
        robots: a Robot or several; environments are shared out evenly, in order.
        num_envs: size N of the batch.
        engine: "native" (C MuJoCo), "mjx", or "auto": native on a CPU, MJX otherwise.
        config, sizes: the task's settings and the padding; `TaskConfig()`, the largest robot's.
        auto_reset: start a new episode, with a new random design, when one ends.
            Without it a finished environment goes on and earns. Callers must take note of its first
            step with `terminated` or `truncated`, ignore what follows, and `reset` or `restart` it.
        threads: physics threads of the native engine, 0 for all cores.
        physics_options: passed on to the engine's constructor.
        mirror: let descriptions hold those of the mirror image of the body, too (`design.mirror`).

    Attributes:
        robots, num_envs, engine, sizes: as given; the engine is "native" or "mjx".
        batch, config, groups, auto_reset: the environments as the engines' loops take them.
        design_dim: D, the largest robot's d, to which designs are padded.
        physics_state: with MJX one PhysicsState per robot, which `rollout` continues and replaces.

    The function that starts episodes is compiled for each robot, in seconds; it then holds about
    700 memory maps, of the 65,530 that Linux grants a process.

    Raises:
        ValueError: for an unknown engine, or fewer environments than robots.
    """

    def __init__(
        self,
        robots: Robot | Sequence[Robot],
        num_envs: int = 256,
        engine: str = "auto",
        config: TaskConfig | None = None,
        sizes: Sizes | None = None,
        auto_reset: bool = True,
        threads: int = 0,
        physics_options: dict | None = None,
        mirror: bool = False,
    ):
        robots = robots if isinstance(robots, list | tuple) else [robots]
        robots = [require_robot(robot) for robot in robots]
        engine = resolved(engine)
        if not robots:
            raise ValueError("robots is empty; expected at least one robot")
        num_envs = require_integer("num_envs", num_envs, 1, MOST_ENVIRONMENTS)
        if num_envs < len(robots):
            raise ValueError(f"num_envs is {num_envs}; {len(robots)} robots need at least as many")
        config = TaskConfig() if config is None else config
        require_kind("config", config, TaskConfig, "shapebody.TaskConfig(...)")
        sizes = Sizes.of(*robots) if sizes is None else sizes
        require_kind("sizes", sizes, Sizes, "Sizes.of(*robots)")
        require_flag("auto_reset", auto_reset)
        require_flag("mirror", mirror)
        require_integer("threads", threads, 0, 4096)
        options = {} if physics_options is None else physics_options
        require_kind("physics_options", options, dict, "of arguments of the engine, by name")
        self.robots, self.num_envs, self.engine = tuple(robots), num_envs, engine
        self.sizes, self.design_dim = sizes, max(robot.design_dim for robot in robots)
        simulate = simulator(engine, threads, options)
        bounds = np.linspace(0, num_envs, len(robots) + 1).astype(int)
        groups = []
        for robot, first, count in zip(robots, bounds, np.diff(bounds), strict=False):
            own = sizes, first, count, config, self.design_dim, mirror
            groups.append(RobotGroup(robot, simulate(robot, count), *own))
        self.physics_state = None
        self._take(Batch(config, tuple(groups), auto_reset))

    def _take(self, batch: Batch) -> None:
        """Work on `batch`; its functions are compiled when they are first called."""
        self.batch = batch
        self._observe = jax.jit(batch.observe)
        self._account = native_rollout.compiled_account(batch)
        self._of_policy: dict[Any, Callable] = {}

    @property
    def config(self) -> TaskConfig:
        """The task's settings."""
        return self.batch.config

    @property
    def groups(self) -> tuple[RobotGroup, ...]:
        """The environments of each robot, with its physics."""
        return self.batch.groups

    @property
    def auto_reset(self) -> bool:
        """Whether a finished episode is followed by a new one."""
        return self.batch.auto_reset

    # ------------------------------------------------------------------ reset

    def reset(
        self,
        key: jax.Array,
        designs=None,
        coefficient=1.0,
        spread: bool = False,
        keys: jax.Array | None = None,
    ) -> Episode:
        """Start all environments and return their state.

        Args:
            key: PRNG key; None where `keys` are given.
            designs: normalized designs, one [d] or one per environment [N, d] (padded to
                the largest robot's d); None draws them from U(-rc, rc) (`design_radius`).
            coefficient: curriculum coefficient c in [0, 1], one number or [N].
            spread: cut the first episodes at random horizons, so that episodes do not all
                end in the same step.
            keys: one key per environment instead of `key`, to pair episodes across designs.

        Raises:
            ValueError: for designs of another shape, outside [-1, 1] or not finite, and for a
                coefficient outside [0, 1].
        """
        # Arguments: a key, c and a streak of every episode.
        n = self.num_envs
        rows = np.arange(n)
        c = _one_per_row("coefficient", coefficient, rows, "fiu", 0, 1, np.float32)
        require_flag("spread", spread)
        if key is not None or keys is None:
            require_key("key", key)
        keys = jax.random.split(key, n) if keys is None else require_key("keys", keys, (n,))
        streaks = jnp.zeros(n, jnp.int32)

        # Designs, and with them bodies, poses and commands.
        if designs is None:
            radius = self.config.design_radius
            designs = np.asarray(draw_designs(keys, c, self.design_dim, radius))
        else:
            designs = self._validated(designs, n)
        states, physics_states = [], []
        for group in self.groups:
            s = group.slice
            f = designs[s, : group.space.dim]
            arguments = keys[s], f, c[s], streaks[s]
            if self.engine == "native":
                ids = np.arange(group.count)
                for chosen, state in native_rollout.begin(self.config, group, ids, *arguments):
                    m = len(chosen)
                    states.append(jax.tree.map(lambda x, m=m: np.asarray(x)[:m], state))
            else:
                state, physics = mjx_rollout.begin(group, *arguments)
                states.append(state)
                physics_states.append(physics)
        state = jax.tree.map(lambda *x: jnp.concatenate(x), *states)

        if spread:
            horizon_key = jax.random.fold_in(key, 1)
            horizon = jax.random.randint(horizon_key, (n,), 1, self.config.horizon + 1)
            state = replace(state, horizon=horizon)
        self.physics_state = tuple(physics_states)
        return state

    def descriptions(self, robot: int, designs) -> Descriptions:
        """Descriptions [S, ...] of designs [S, d] of robot number `robot`, padded to this batch.

        Raises:
            ValueError: for designs of another shape, outside [-1, 1] or not finite.
        """
        last = len(self.groups) - 1
        group = self.groups[require_integer("robot (its number in this batch)", robot, 0, last)]
        designs = group.space.validate(designs)
        if designs.ndim != 2 or len(designs) == 0:
            raise ValueError(
                f"designs have shape {designs.shape}; expected at least one row of "
                f"[S, {group.space.dim}]"
            )
        return group.bodies(designs)[0]

    def _validated(self, designs, count: int, rows=None):
        """Designs [count, D] of environments `rows` (all if not given), from as many or one [D].

        D is the largest robot's; numbers beyond a robot's own d are padding and may be anything.
        """
        dim = self.design_dim
        designs = single(require_array("designs", designs, finite=False))
        if designs.shape not in ((dim,), (1, dim), (count, dim)):
            raise ValueError(
                f"designs have shape {designs.shape}; expected one design [{dim}] or one per "
                f"environment [{count}, {dim}], padded to the length of the largest robot's"
            )
        designs = np.broadcast_to(designs, (count, dim))
        rows = np.arange(count) if rows is None else rows
        for group in self.groups:
            own = group.owned(rows)
            try:
                group.space.validate(designs[own, : group.space.dim])
            except ValueError as error:
                raise ValueError(f"designs of robot {group.robot.name!r}: {error}") from error
        return designs

    def with_task(self, config: TaskConfig) -> Locomotion:
        """The same environments with other settings of the task.

        They share physics and the compiled functions that start episodes: `reset` or `restore` one
        before using it after the other.

        Raises:
            ValueError: if a setting differs that the start of an episode depends on.
        """
        require_kind("config", config, TaskConfig, "shapebody.TaskConfig(...)")
        for name in vars(config):
            old, new = getattr(self.config, name), getattr(config, name)
            if name.startswith(START_SETTINGS) and old != new:
                raise ValueError(
                    f"{name} is {new!r} instead of {old!r}; episodes would start in another way: "
                    "create another Locomotion"
                )
        other = copy.copy(self)
        other._take(replace(self.batch, config=config))
        return other

    def restart(
        self, state: Episode, rows, keys: jax.Array, designs=None, coefficient=1.0, streak=0
    ) -> Episode:
        """Native engine: start new episodes in some environments, while the others go on.

        Args:
            state: from `reset`, `step` or `rollout`.
            rows: [R] numbers of the environments, ascending.
            keys: [R] one key per new episode.
            designs: [R, d], padded to the largest robot's d; None draws them as `reset` does.
            coefficient: c of the new episodes in [0, 1], one number or [R].
            streak: successes (+) or failures (-) in a row before them, one integer or [R].

        Returns:
            The new state.

        Raises:
            ValueError: for designs of another shape, outside [-1, 1] or not finite.
        """
        self._require_native("restart")
        require_kind("state", state, Episode, "what reset, step or rollout returned")
        rows = require_array("rows", rows, kinds="iu")
        if rows.ndim != 1:
            raise refuse("rows", rows, "a list of numbers of environments")
        if rows.size and (rows.min() < 0 or rows.max() >= self.num_envs):
            raise ValueError(
                f"rows reach from {rows.min()} to {rows.max()}; expected numbers of environments, "
                f"0 to {self.num_envs - 1}"
            )
        keys = np.asarray(require_key("keys", keys, rows.shape))
        coefficient = _one_per_row("coefficient", coefficient, rows, "fiu", 0, 1, np.float32)
        streak = _one_per_row("streak", streak, rows, "iu", -(2**31), 2**31 - 1, np.int32)
        if designs is not None:
            designs = self._validated(designs, len(rows), rows)
        return native_rollout.restart(self.batch, state, rows, keys, designs, coefficient, streak)

    # ------------------------------------------------------------------ rollouts

    def rollout(
        self, policy: PolicyFunction, params, state: Episode, key: jax.Array, length: int
    ) -> tuple[Episode, Trajectory]:
        """Run `policy` for `length` control steps in all environments.

        Args:
            policy: pure function, see `trajectory.PolicyFunction`. The same object must be passed
                in every call: one compilation belongs to it.
            params: its parameters.
            state: from `reset` or the last rollout. With MJX it must be the latest: the state of
                the physics that belongs to it is `physics_state`.
            key: PRNG key for the policy's randomness.
            length: number T of control steps.

        Returns:
            The new state and the Trajectory.
        """
        self._check_call(policy, state, key)
        require_integer("length", length, 1, 1_000_000)
        if self.engine == "mjx":
            rollout = self._compiled(mjx_rollout.compiled_rollout, policy, length)
            state, self.physics_state, trajectory = rollout(params, state, self.physics_state, key)
            return state, trajectory
        act = self._compiled(native_rollout.compiled_act, policy)
        functions = act, self._account, self._observe
        return native_rollout.rollout(self.batch, *functions, params, state, key, length)

    def step(
        self, policy: PolicyFunction, params, state: Episode, key: jax.Array, running=None
    ) -> tuple[Episode, StepRecord, Outcome]:
        """Native engine: one control step of `policy` in all environments.

        Args:
            policy, params, state, key: as in `rollout`.
            running: bool [N], None for all. Where it is False the body is not simulated, which
                saves time, and what is returned about that environment means nothing.

        Returns:
            The new state, the StepRecord (NumPy arrays), and the Outcome.
        """
        self._require_native("step")
        self._check_call(policy, state, key)
        if running is not None:
            running = require_array("running", running, (self.num_envs,), kinds="b")
        act = self._compiled(native_rollout.compiled_act, policy)
        return native_rollout.control_step(
            self.batch, act, self._account, params, state, key, running
        )

    def _require_native(self, method: str) -> None:
        if self.engine != "native":
            raise ValueError(
                f"{method} is for the native engine, and this batch runs on {self.engine!r}; "
                "use rollout, or create it with engine='native'"
            )

    def _check_call(self, policy, state, key) -> None:
        require_function("policy", policy)
        require_kind("state", state, Episode, "what reset, step or rollout returned")
        require_key("key", key)

    def _compiled(self, compiled: Callable, *key) -> Callable:
        """compiled(batch, *key), where `key` begins with a policy; made once for each."""
        if key not in self._of_policy:
            self._of_policy[key] = compiled(self.batch, *key)
        return self._of_policy[key]

    # ------------------------------------------------------------------ exact resume

    def physics_arrays(self) -> list[dict[str, np.ndarray]]:
        """The physics state of every robot's environments, for `restore` (native engine)."""
        self._require_native("physics_arrays")
        return [{k: np.array(v) for k, v in group.physics.state().items()} for group in self.groups]

    def restore(self, state: Episode, arrays: list[dict[str, np.ndarray]]) -> None:
        """Continue from a saved `state` and its `physics_arrays` (native engine).

        Raises:
            ValueError: for arrays of other robots or of another number of environments.
        """
        self._require_native("restore")
        require_kind("state", state, Episode, "what reset, step or rollout returned")
        arrays = require_list("arrays", arrays)
        if len(arrays) != len(self.groups):
            raise ValueError(
                f"arrays has {len(arrays)} entries; expected one per robot, {len(self.groups)}: "
                "what physics_arrays returned"
            )
        for saved in arrays:
            require_kind("an entry of arrays", saved, dict, "what physics_arrays returned")
        designs = np.asarray(state.design)
        for group, saved in zip(self.groups, arrays, strict=True):
            _, embodiments = group.bodies(designs[group.slice, : group.space.dim])
            group.physics.set_designs(np.arange(group.count), embodiments)
            group.physics.restore(saved)


def _one_per_row(name: str, value, rows, kinds: str, low: int, high: int, dtype) -> np.ndarray:
    """One number for each of `rows`, from as many or one; ValueError if any is out of range."""
    values = require_array(name, value, kinds=kinds)
    if values.shape not in ((), rows.shape) or np.any((values < low) | (values > high)):
        raise refuse(name, value, f"one number from {low} to {high}, or {len(rows)}")
    return np.broadcast_to(np.asarray(value, dtype), rows.shape)
