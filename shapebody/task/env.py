"""The locomotion environment: episodes of `episode.py` on one of two physics engines.

With the native engine a Python loop alternates jitted task code with one threaded call of
C MuJoCo; with MJX the whole rollout is one jitted scan. Environments of several robots
share one batch: joints, feet and spheres are padded to the largest robot and masked.
"""

import copy
import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from shapebody.arguments import (
    refuse,
    require_array,
    require_engine,
    require_flag,
    require_function,
    require_integer,
    require_key,
    require_kind,
    require_list,
    require_number,
    single,
)
from shapebody.design.descriptions import Descriptions, Sizes, describe
from shapebody.design.kinematics import kinematics
from shapebody.design.space import DesignSpace
from shapebody.robot.robot import Robot, require_robot
from shapebody.rotations import quaternion_product
from shapebody.task import episode as episodes
from shapebody.task import randomization
from shapebody.task.config import TaskConfig
from shapebody.task.episode import Episode, Outcome
from shapebody.task.observations import Observation
from shapebody.task.sensors import Readings, reader

RESET_SLOTS = 16
"""Finished environments are restarted in chunks of this size, so that one compiled
function serves any number of them."""

MOST_ENVIRONMENTS = 2**20
"""Largest batch."""

START_SETTINGS = ("horizon", "command", "initial", "action_delay", "delay", "mixed_delay")
"""Beginnings of the names of those fields of TaskConfig that the start of an episode depends on."""

Policy = Callable[[Any, jax.Array, Descriptions, Observation], tuple[jax.Array, Any]]
"""(params, key, descriptions[N], observation[N]) -> (action[N, J], extra pytree[N])."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Trajectory:
    """T control steps of N environments.

    A design is fixed for an episode, so a rollout holds few of them. `descriptions` keeps
    two per environment, the one at the start of the rollout and the one at its end, and
    `slot` says which applies in each step. Steps of an episode that began and ended within
    the rollout have neither; `valid` is 0 there.
    """

    observation: Observation  # [T, N, ...]
    action: jax.Array  # [T, N, J]
    extra: Any  # [T, N, ...] what the policy returned beside the action
    reward: jax.Array  # [T, N]
    terminated: jax.Array  # [T, N] bool
    truncated: jax.Array  # [T, N] bool
    finite: jax.Array  # [T, N] bool
    slot: jax.Array  # [T, N] int32, 0 or 1
    valid: jax.Array  # [T, N] float32
    descriptions: Descriptions  # [2, N, ...]
    last_observation: Observation  # [N, ...] after the last step
    episode_return: jax.Array  # [T, N] return so far, episode_length likewise
    episode_length: jax.Array
    episode_error: jax.Array  # [T, N] mean over time and axes of |v_xy - c_xy| so far, m/s,
    # each term at most twice the command limit
    coefficient: jax.Array  # [T, N] curriculum coefficient


class StepRecord(NamedTuple):
    """What one control step adds to a trajectory."""

    observation: Observation
    action: jax.Array
    extra: Any
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    finite: jax.Array
    episode_return: jax.Array
    episode_length: jax.Array
    episode_error: jax.Array
    coefficient: jax.Array


class _Group:
    """The environments of one robot: a slice of the batch with its own physics."""

    def __init__(self, robot: Robot, sizes: Sizes, first: int, count: int, config, design_dim):
        self.robot, self.first, self.count = robot, first, count
        self.slice = slice(first, first + count)
        self.space = DesignSpace(robot)
        self.read = reader(robot, sizes)
        self.start = jax.vmap(
            _starter(robot, self.space, sizes, config, design_dim), in_axes=(0, 0, 0, 0)
        )
        self.jitted_start = jax.jit(self.start)
        self.qvel_index = np.asarray(robot.qvel_index)


def _starter(robot: Robot, space: DesignSpace, sizes: Sizes, config: TaskConfig, design_dim: int):
    """(key, design[d], coefficient, streak) -> (Episode, Embodiment, qpos, qvel)."""
    to_descriptions, forward = describe(robot, sizes), kinematics(robot)
    home = jnp.asarray(robot.home, jnp.float32)
    site_quat = jnp.asarray(robot.model.site_quat[robot.imu_site], jnp.float32)
    qpos_index = np.asarray(robot.qpos_index)

    def start(key, design, coefficient, streak):
        embodiment = space(design)
        d = to_descriptions(embodiment)
        pose_key, episode_key = jax.random.split(key)
        quat, joints = randomization.initial_pose(config, pose_key, d, coefficient)
        qpos = home.at[:2].set(0.0).at[2].set(d.home_height).at[3:7].set(quat)
        qpos = qpos.at[qpos_index].set(joints[: robot.num_actuators])
        # Put the centre of the lowest foot at floor height, as at the nominal pose.
        frames = forward(embodiment, qpos)
        lift = -jnp.min(frames.geom_pos[np.asarray(robot.feet), 2])
        qpos = qpos.at[2].add(lift)
        rise = jnp.array([0.0, 0.0, 1.0]) * lift

        def padded(x, length):
            return jnp.pad(x, [(0, length - x.shape[0])] + [(0, 0)] * (x.ndim - 1))

        feet, spheres = np.asarray(robot.feet), np.asarray(robot.spheres)
        readings = Readings(
            joint_position=joints,
            joint_velocity=jnp.zeros(sizes.joints),
            joint_torque=jnp.zeros(sizes.joints),
            trunk_velocity=jnp.zeros(6),
            angular_velocity=jnp.zeros(3),
            linear_velocity=jnp.zeros(3),
            imu_height=frames.site_pos[robot.imu_site, 2] + lift,
            imu_quat=quaternion_product(quat, site_quat),
            foot_position=padded(frames.geom_pos[feet] + rise, sizes.feet),
            foot_down=padded(frames.geom_rot[feet, 2], sizes.feet),
            foot_velocity=jnp.zeros((sizes.feet, 3)),
            sphere_position=padded(frames.geom_pos[spheres] + rise, sizes.spheres),
            finite=jnp.asarray(True),
        )
        stored = jnp.pad(design, (0, design_dim - space.dim))
        state = episodes.start(config, episode_key, stored, d, readings, coefficient, streak)
        return state, embodiment, qpos, jnp.zeros(robot.model.nv)

    return start


class Locomotion:
    """A batch of environments of one or more robots.

    Args:
        robots: a Robot or several; environments are shared out evenly, in order.
        num_envs: size N of the batch.
        engine: "native" (C MuJoCo), "mjx", or "auto": native on a CPU, MJX otherwise.
        config: the task's settings.
        sizes: padding; by default the largest of `robots`.
        auto_reset: start a new episode, with a new random design, when one ends.
            Without it a finished environment goes on: its body moves, rewards still come, and
            `episode_return` grows. Callers must take note of an environment's first step with
            `terminated` or `truncated`, ignore what follows, and `reset` or `restart` it.
        threads: physics threads of the native engine, 0 for all cores.
        physics_options: passed on to the engine's constructor.

    The function that starts episodes is compiled for each robot, some seconds each; it then holds
    about 700 memory maps, of the 65,530 that Linux grants a process.

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
    ):
        several = isinstance(robots, list | tuple)
        robots = [require_robot(robot) for robot in (robots if several else [robots])]
        require_engine("engine", engine)
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
        require_integer("threads", threads, 0, 4096)
        options = {} if physics_options is None else physics_options
        require_kind("physics_options", options, dict, "of arguments of the engine, by name")
        if engine == "auto":
            engine = "native" if jax.default_backend() == "cpu" else "mjx"
        self.robots, self.num_envs, self.engine = tuple(robots), num_envs, engine
        self.config, self.sizes = config, sizes
        self.auto_reset = auto_reset
        self.design_dim = max(robot.design_dim for robot in robots)
        bounds = np.linspace(0, num_envs, len(robots) + 1).astype(int)
        self.groups = [
            _Group(robot, self.sizes, first, last - first, self.config, self.design_dim)
            for robot, first, last in zip(robots, bounds[:-1], bounds[1:], strict=True)
        ]
        if engine == "native":
            from shapebody.physics.native import NativePhysics

            _require_options(options, NativePhysics)
            for group in self.groups:
                group.physics = NativePhysics(group.robot, group.count, threads=threads, **options)
        else:
            from shapebody.physics.mjx import MjxPhysics

            _require_options(options, MjxPhysics)
            for group in self.groups:
                group.physics = MjxPhysics(group.robot, group.count, **options)
        self._account = jax.jit(self._moving_part)
        self._steps: dict[Any, Callable] = {}
        self.physics_state = None

    # ------------------------------------------------------------------ task, pure

    def _observe(self, state: Episode):
        return jax.vmap(partial(episodes.observe, self.config))(state)

    def _control(self, state: Episode, action):
        return jax.vmap(partial(episodes.control, self.config))(state, action)

    def _advance(self, state: Episode, raw):
        """raw: per group (qpos, qvel, sensordata, finite)."""
        parts = [group.read(*out) for group, out in zip(self.groups, raw, strict=True)]
        readings = jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
        state, outcome = jax.vmap(partial(episodes.advance, self.config))(state, readings)
        coefficient, streak = jax.vmap(partial(episodes.next_coefficient, self.config))(
            state, outcome.terminated
        )
        return state, outcome, (coefficient, streak, _next_key(state.key))

    def _moving_part(self, state: Episode, raw):
        """`_advance` without what an episode keeps: a compiled function would copy its results."""
        state, *others = self._advance(state, raw)
        return replace(state, design=None, descriptions=None), *others

    # ------------------------------------------------------------------ reset

    def reset(
        self,
        key: jax.Array,
        designs=None,
        coefficient: float = 1.0,
        spread: bool = False,
        keys: jax.Array | None = None,
    ) -> Episode:
        """Start all environments and return their state.

        Args:
            key: PRNG key; None where `keys` are given.
            designs: normalized designs, one [d] or one per environment [N, d] (padded to
                the largest robot's d); None draws them from U(-rc, rc) (`design_radius`).
            coefficient: curriculum coefficient c in [0, 1] of every environment.
            spread: cut the first episodes at random horizons, so that episodes do not all
                end in the same step.
            keys: one key per environment instead of `key`, to pair episodes across designs.

        Raises:
            ValueError: for designs of another shape, outside [-1, 1] or not finite, and for a
                coefficient outside [0, 1].
        """
        n = self.num_envs
        require_number("coefficient", coefficient, 0, 1)
        require_flag("spread", spread)
        if key is not None or keys is None:
            require_key("key", key)
        if keys is not None:
            require_key("keys", keys, (n,))
        else:
            keys = jax.random.split(key, n)
        coefficients = jnp.full(n, coefficient, jnp.float32)
        streaks = jnp.zeros(n, jnp.int32)
        if designs is None:
            designs = np.asarray(
                _draw_designs(keys, coefficients, self.design_dim, self.config.design_radius)
            )
        else:
            designs = self._validated(designs, n)
        states, physics_states = [], []
        for group in self.groups:
            s = group.slice
            f = designs[s, : group.space.dim]
            if self.engine == "native":
                ids = np.arange(group.count)
                states += self._begin(group, ids, keys[s], f, coefficients[s], streaks[s])
            else:
                arguments = (keys[s], jnp.asarray(f), coefficients[s], streaks[s])
                state, *physics = group.jitted_start(*arguments)
                states.append(state)
                physics_states.append(group.physics.init(*physics))
        state = jax.tree.map(lambda *x: jnp.concatenate(x), *states)
        if spread:
            horizon = jax.random.randint(
                jax.random.fold_in(key, 1), (n,), 1, self.config.horizon + 1
            )
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
        return self._bodies(group, designs)[0]

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
            own = (rows >= group.first) & (rows < group.first + group.count)
            try:
                group.space.validate(designs[own, : group.space.dim])
            except ValueError as error:
                raise ValueError(f"designs of robot {group.robot.name!r}: {error}") from error
        return designs

    def _bodies(self, group, designs):
        """Descriptions and embodiments of designs [S, d], as NumPy arrays.

        They come from the function that starts episodes, in chunks of its size, so that nothing
        is compiled for them and every bit is that of an episode.
        """
        designs = np.asarray(designs, np.float32)
        keys = np.asarray(jax.random.split(jax.random.PRNGKey(0), RESET_SLOTS))
        zeros = np.zeros(RESET_SLOTS, np.float32), np.zeros(RESET_SLOTS, np.int32)
        parts = []
        for at in range(0, len(designs), RESET_SLOTS):
            rows = np.minimum(np.arange(at, at + RESET_SLOTS), len(designs) - 1)
            state, embodiment, *_ = group.jitted_start(keys, designs[rows], *zeros)
            parts.append(jax.tree.map(np.asarray, (state.descriptions, embodiment)))
        return jax.tree.map(lambda *x: np.concatenate(x)[: len(designs)], *parts)

    def with_task(self, config: TaskConfig) -> "Locomotion":
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
        other.config = config
        other._account = jax.jit(other._moving_part)
        other._steps = {}
        return other

    def _begin(self, group, ids, keys, designs, coefficients, streaks) -> list[Episode]:
        """Native engine: start episodes in environments `ids` of a group, RESET_SLOTS at a
        time, so that one compiled function serves any number of them. `designs` None draws them."""
        states = []
        keys, coefficients, streaks = (np.asarray(x) for x in (keys, coefficients, streaks))
        for at in range(0, len(ids), RESET_SLOTS):
            chosen = ids[at : at + RESET_SLOTS]
            m = len(chosen)
            # Unused slots repeat the first one.
            rows = np.concatenate([np.arange(at, at + m), np.full(RESET_SLOTS - m, at)])
            k, c = keys[rows], coefficients[rows]
            if designs is None:
                f = _draw_designs(k, c, group.space.dim, self.config.design_radius)
            else:
                f = designs[rows]
            state, embodiment, qpos, qvel = group.jitted_start(k, f, c, streaks[rows])
            state, embodiment, qpos, qvel = jax.tree.map(
                lambda x, m=m: np.asarray(x)[:m], (state, embodiment, qpos, qvel)
            )
            group.physics.set_designs(chosen, embodiment)
            group.physics.set_state(chosen, qpos, qvel)
            states.append(state)
        return states

    def restart(
        self, state: Episode, rows, keys: jax.Array, designs=None, coefficient=1.0, streak=0
    ) -> Episode:
        """Native engine: start new episodes in some environments, while the others go on.

        Args:
            state: from `reset`, `step` or `rollout`.
            rows: [R] numbers of the environments, ascending.
            keys: [R] one key per new episode.
            designs: [R, d], padded to the largest robot's d; None draws them as `reset` does.
            coefficient: c of the new episodes, one number or [R]; `streak` likewise.

        Returns:
            The new state.

        Raises:
            ValueError: for designs of another shape, outside [-1, 1] or not finite.
        """
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
        for name, value, kinds, low, high in (
            ("coefficient", coefficient, "fiu", 0, 1),
            ("streak", streak, "iu", -(2**31), 2**31 - 1),
        ):
            values = require_array(name, value, kinds=kinds)
            right = values.shape in ((), rows.shape) and np.all((values >= low) & (values <= high))
            if not right:
                expected = f"one number from {low} to {high}, or one for each of rows"
                raise refuse(name, value, expected)
        if designs is not None:
            designs = self._validated(designs, len(rows), rows)
        coefficient = np.broadcast_to(np.asarray(coefficient, np.float32), rows.shape)
        streak = np.broadcast_to(np.asarray(streak, np.int32), rows.shape)
        for group in self.groups:
            own = (rows >= group.first) & (rows < group.first + group.count)
            if not own.any():
                continue
            f = None if designs is None else designs[own, : group.space.dim]
            ids = rows[own] - group.first
            fresh = self._begin(group, ids, keys[own], f, coefficient[own], streak[own])
            if len(fresh) > 1:
                fresh = [jax.tree.map(lambda *x: np.concatenate(x), *fresh)]
            state = jax.tree.map(
                lambda old, new, at=rows[own]: _replaced(old, at, new), state, *fresh
            )
        return state

    # ------------------------------------------------------------------ rollouts

    def rollout(
        self, policy: Policy, params, state: Episode, key: jax.Array, length: int
    ) -> tuple[Episode, Trajectory]:
        """Run `policy` for `length` control steps in all environments.

        Args:
            policy: pure function, see `Policy`. The same object must be passed in every
                call: one compilation belongs to it.
            params: its parameters.
            state: from `reset` or the last rollout.
            key: PRNG key for the policy's randomness.
            length: number T of control steps.

        Returns:
            The new state and the Trajectory.
        """
        self._check_call(policy, state, key)
        require_integer("length", length, 1, 1_000_000)
        if self.engine == "mjx":
            return self._rollout_mjx(policy, params, state, key, length)
        first = state.descriptions
        records = []
        for step_key in _step_keys(key, length):
            state, record, _ = self.step(policy, params, state, step_key)
            records.append(record)
        stacked = jax.tree.map(lambda *x: np.stack(x), *records)
        return state, self._trajectory(stacked, first, state)

    def step(self, policy: Policy, params, state: Episode, key, running=None):
        """One control step with the native engine: (state, StepRecord of numpy arrays, Outcome).

        Where `running` ([N] bool, all if None) is False the body is not simulated, which saves
        time, and what is returned about that environment means nothing.
        """
        self._check_call(policy, state, key)
        if running is not None:
            running = require_array("running", running, (self.num_envs,), kinds="b")
        act = self._compiled(policy)
        moved, targets, observation, action, extra = act(params, state, key)
        target, trunk, velocity = map(np.asarray, targets)
        design, descriptions = state.design, state.descriptions
        state = replace(state, **moved)
        raw = []
        for group in self.groups:
            physics, s, nu = group.physics, group.slice, group.robot.num_actuators
            physics.qvel[:, :6] = trunk[s]
            physics.qvel[:, group.qvel_index] = velocity[s, :nu]
            qpos, qvel, sensordata, finite = physics.step(
                target[s, :nu], running=None if running is None else running[s]
            )
            raw.append((_f32(qpos), _f32(qvel), _f32(sensordata), np.array(finite)))
        state, outcome, following = self._account(state, tuple(raw))
        state = replace(state, design=design, descriptions=descriptions)
        record = _record(state, observation, action, extra, outcome)
        record = jax.tree.map(np.asarray, record)
        done = record.terminated | record.truncated
        if self.auto_reset and done.any():
            rows = np.flatnonzero(done)
            coefficient, streak, keys = (np.asarray(x)[rows] for x in following)
            state = self.restart(state, rows, keys, None, coefficient, streak)
        return state, record, outcome

    def _check_call(self, policy, state, key) -> None:
        require_function("policy", policy)
        require_kind("state", state, Episode, "what reset, step or rollout returned")
        require_key("key", key)

    def _compiled(self, policy: Policy):
        if policy not in self._steps:

            def act(params, state, key):
                state, observation = self._observe(state)
                action, extra = policy(params, key, state.descriptions, observation)
                state, *targets = self._control(state, action)
                moved = {"clock": state.clock, "actions": state.actions}
                return moved, targets, observation, action, extra

            self._steps[policy] = jax.jit(act)
        return self._steps[policy]

    def _trajectory(self, steps: StepRecord, first: Descriptions, state: Episode) -> Trajectory:
        xp = np if isinstance(steps.reward, np.ndarray) else jnp
        done = steps.terminated | steps.truncated
        if not self.auto_reset:
            done = xp.zeros_like(done)
        # Episode number of each step within this rollout, and of the state after it.
        number = xp.cumsum(done, 0) - done
        final = xp.sum(done, 0)
        slot = ((number == final) & (final > 0)).astype(np.int32)
        valid = ((number == 0) | (number == final)).astype(np.float32)
        _, last_observation = self._observe_jit(state)
        descriptions = jax.tree.map(lambda a, b: jnp.stack([a, b]), first, state.descriptions)
        return Trajectory(
            **steps._asdict(),
            slot=slot,
            valid=valid,
            descriptions=descriptions,
            last_observation=last_observation,
        )

    @property
    def _observe_jit(self):
        if "observe" not in self._steps:
            self._steps["observe"] = jax.jit(self._observe)
        return self._steps["observe"]

    def _rollout_mjx(self, policy, params, state, key, length):
        name = (policy, length)
        if name not in self._steps:
            self._steps[name] = jax.jit(partial(self._scan, policy, length))
        state, self.physics_state, trajectory = self._steps[name](
            params, state, self.physics_state, key
        )
        return state, trajectory

    def _scan(self, policy, length, params, state, physics, key):
        first = state.descriptions

        def control_step(carry, key):
            state, physics = carry
            state, observation = self._observe(state)
            action, extra = policy(params, key, state.descriptions, observation)
            state, target, trunk, velocity = self._control(state, action)
            stepped, raw = [], []
            for group, one in zip(self.groups, physics, strict=True):
                s, nu = group.slice, group.robot.num_actuators
                qvel = group.physics.velocity(one).at[:, :6].set(trunk[s])
                qvel = qvel.at[:, group.qvel_index].set(velocity[s, :nu])
                one = group.physics.with_velocity(one, qvel)
                one, *out = group.physics.step(one, target[s, :nu])
                stepped.append(one)
                raw.append(tuple(out))
            state, outcome, following = self._advance(state, tuple(raw))
            record = _record(state, observation, action, extra, outcome)
            if self.auto_reset:
                done = outcome.terminated | outcome.truncated
                state, stepped = self._restart_mjx(state, stepped, done, following)
            return (state, tuple(stepped)), record

        keys = jax.random.split(key, length)
        (state, physics), records = jax.lax.scan(control_step, (state, physics), keys)
        return state, physics, self._trajectory(records, first, state)

    def _restart_mjx(self, state, physics, done, following):
        coefficient, streak, keys = following
        fresh, restarted = [], []
        for group, one in zip(self.groups, physics, strict=True):
            s = group.slice
            radius = self.config.design_radius
            designs = _draw_designs(keys[s], coefficient[s], group.space.dim, radius)
            new, embodiment, qpos, qvel = group.start(keys[s], designs, coefficient[s], streak[s])
            fresh.append(new)
            restarted.append(group.physics.reset(one, done[s], embodiment, qpos, qvel))
        fresh = jax.tree.map(lambda *x: jnp.concatenate(x), *fresh)

        def choose(new, old):
            return jnp.where(done.reshape(done.shape + (1,) * (old.ndim - 1)), new, old)

        return jax.tree.map(choose, fresh, state), restarted

    # ------------------------------------------------------------------ exact resume

    def physics_arrays(self) -> list[dict[str, np.ndarray]]:
        """The physics state of every robot's environments, for `restore` (native engine)."""
        return [{k: np.array(v) for k, v in group.physics.state().items()} for group in self.groups]

    def restore(self, state: Episode, arrays: list[dict[str, np.ndarray]]) -> None:
        """Continue from a saved `state` and its `physics_arrays` (native engine)."""
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
            _, embodiments = self._bodies(group, designs[group.slice, : group.space.dim])
            group.physics.set_designs(np.arange(group.count), embodiments)
            group.physics.restore(saved)


def _require_options(options: dict, engine) -> None:
    """ValueError if an engine's constructor does not take these."""
    given = ("robot", "num_envs", "threads")
    known = [name for name in inspect.signature(engine).parameters if name not in given]
    for name in options:
        if name not in known:
            raise refuse("a key of physics_options", name, f"one of {', '.join(known)}")


def _record(state: Episode, observation, action, extra, outcome: Outcome) -> StepRecord:
    return StepRecord(
        observation=observation,
        action=action,
        extra=extra,
        reward=outcome.reward,
        terminated=outcome.terminated,
        truncated=outcome.truncated,
        finite=outcome.finite,
        episode_return=state.total_reward,
        episode_length=state.step,
        episode_error=state.total_error / jnp.maximum(state.step, 1),
        coefficient=state.coefficient,
    )


def _f32(x):
    return np.asarray(x, np.float32)


def _replaced(old, rows, new):
    result = np.array(old)
    result[rows] = new
    return result


@partial(jax.jit, static_argnums=1)
def _step_keys(key, length: int):
    """A key for each step of a rollout."""
    return jax.vmap(lambda t: jax.random.fold_in(key, t))(jnp.arange(length))


@jax.jit
def _next_key(keys):
    """Each environment's key for its next episode, from its key for this one."""
    return jax.vmap(lambda key: jax.random.fold_in(key, 2**31 - 1))(keys)


@partial(jax.jit, static_argnums=(2, 3))
def _draw_designs(keys, coefficients, dim: int, radius: tuple[float, float]):
    """f ~ U([-rc, rc]^d), one per key (Section 3.1), with r uniform between `radius`."""

    def draw(key, c):
        design = jax.random.uniform(jax.random.fold_in(key, 7), (dim,), minval=-1.0, maxval=1.0)
        low, high = radius
        r = jax.random.uniform(jax.random.fold_in(key, 8), minval=low, maxval=high)
        return design * (c * r)

    return jax.vmap(draw)(keys, coefficients)
