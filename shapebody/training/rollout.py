"""Collecting rollouts: the actor beside the learner, the watch on failures, the state bank.

On a CPU, a thread of the actor's own collects the next rollout while the learner works on the last
one. The actor's policy is then one update old, which the losses account for (`losses.py`). On an
accelerator there is nothing to overlap: the device does one thing at a time.
"""

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import jax
import numpy as np

from shapebody.arguments import require_flag, require_kind
from shapebody.networks.policy import Policy, log_prob
from shapebody.stored import ARRAYS_LIMIT
from shapebody.task.env import Locomotion
from shapebody.task.trajectory import Trajectory
from shapebody.training.config import TrainConfig


def make_policy_function(policy: Policy, mean_actions: bool = False):
    """The policy as `Locomotion.rollout` wants it; extra is the log density of the action.

    mean_actions: act without exploration noise.
    """
    require_kind("policy", policy, Policy, "shapebody.Policy(...)")
    require_flag("mean_actions", mean_actions)

    def act(variables, key, descriptions, observation):
        mean, std = policy.apply(variables, descriptions, observation)
        noise = 0.0 if mean_actions else jax.random.normal(key, mean.shape)
        action = mean + std * noise * descriptions.joint_mask
        return action, log_prob(mean, std, action, descriptions.joint_mask)

    return act


class Actor:
    """Collects the rollouts of a run, each of which can be repeated exactly.

    `behaviour` (the policy's variables), `state` and `physics` are those with which the latest
    rollout began; together with its number they determine it.

    Args:
        env: the environments.
        act: from `make_policy_function`.
        key: PRNG key of the run.
        length: control steps of a rollout.
    """

    def __init__(self, env: Locomotion, act, key, length: int):
        self.env, self.act, self.key, self.length = env, act, key, length
        self.beside = env.engine == "native"
        """Whether rollouts are collected beside the learner."""
        self.behaviour = self.state = self.physics = None
        self._after = None  # the state after the latest finished rollout
        self._thread = self._pending = None

    def reset(self, coefficient, number: int = 0) -> None:
        """Begin new episodes before rollout `number`, at one curriculum coefficient or [N]."""
        key = jax.random.fold_in(self.key, 2**31 + number) if number else self.key
        self.state = self.env.reset(key, coefficient=coefficient, spread=True)
        self.physics = self._engine_state()

    def resume(self, behaviour, state, physics) -> None:
        """Take over what another actor's latest rollout began with."""
        self.behaviour, self.state, self.physics = behaviour, state, physics

    def _engine_state(self):
        native = self.env.engine == "native"
        return self.env.physics_arrays() if native else self.env.physics_state

    def __enter__(self) -> "Actor":
        # Whatever the engine did in between, it begins where the rollout did.
        if self.env.engine == "native":
            self.env.restore(self.state, self.physics)
        else:
            self.env.physics_state = self.physics
        self._thread = ThreadPoolExecutor(1)
        return self

    def __exit__(self, *_) -> None:
        self._thread.shutdown()  # waits for the rollout under way

    def repeat(self, number: int) -> Trajectory:
        """Collect rollout `number`, which begins with `behaviour`, `state` and `physics`."""
        self._after, trajectory = self._collect(number)
        return trajectory

    def begin(self, behaviour, number: int) -> None:
        """Begin rollout `number` with a policy: in the thread, or only once it is asked for."""
        self.behaviour, self.state, self.physics = behaviour, self._after, self._engine_state()
        if self.beside:
            self._pending = self._thread.submit(self._collect, number)
        else:
            self._pending = number

    def wait(self) -> None:
        """Wait for the rollout in the thread, if there is one."""
        if isinstance(self._pending, Future):
            self._pending.result()

    def result(self) -> Trajectory:
        """The rollout that was begun."""
        if not isinstance(self._pending, Future):
            return self.repeat(self._pending)
        self._after, trajectory = self._pending.result()
        return trajectory

    def _collect(self, number: int):
        key = jax.random.fold_in(self.key, 2 * number)
        return self.env.rollout(self.act, self.behaviour, self.state, key, self.length)


class Failures:
    """Watches rollouts for robots whose simulation always fails: nothing can be learned there."""

    LEAST = 16
    """Failed episodes without one that ends otherwise, at least; and one per environment."""

    def __init__(self, env: Locomotion):
        self.names = [robot.name for robot in env.robots]
        counts = [group.count for group in env.groups]
        self.owner = np.repeat(np.arange(len(counts)), counts)
        self.limits = np.maximum(counts, self.LEAST)
        self.failed = np.zeros(len(counts), int)

    def add(self, trajectory: Trajectory) -> None:
        """Count the episodes that ended in a rollout.

        Raises:
            ValueError: if all latest episodes of a robot ended with a simulation that is not
                finite, as many as it has environments and at least LEAST.
        """
        finite = np.asarray(trajectory.finite)
        ended = np.asarray(trajectory.terminated) | np.asarray(trajectory.truncated)

        def per_robot(which):
            return np.bincount(self.owner, which.sum(0), len(self.failed)).astype(int)

        sound = per_robot(ended & finite) > 0
        self.failed = np.where(sound, 0, self.failed + per_robot(~finite))
        for name, failed, limit in zip(self.names, self.failed, self.limits, strict=True):
            if failed >= limit:
                raise ValueError(
                    f"the simulation of robot {name!r} fails in every episode: its positions or "
                    f"velocities became infinite in {failed} of the last {failed} episodes, so "
                    "there is nothing to learn from; check the file (shapebody.validate_robot), "
                    "above all gains, masses, inertias and armature, or give it a smaller timestep"
                )


def collect_states(
    env: Locomotion, act, variables, key, length: int, count: int, rollouts: int, seed: int
):
    """States from rollouts of a policy on random designs at c = 1 (Section 3.2).

    Args:
        env: the environments; designs and episodes are those of its task, with c held at 1.
        act, variables: the policy, from `make_policy_function`, and its variables.
        key: PRNG key of the rollouts.
        length: control steps of a rollout.
        count: number M of states.
        rollouts: number of rollouts that they come from.
        seed: of the choice of states.

    Returns:
        (Observation [M, ...] of numpy arrays, robot index int32[M]); None if the simulation fails
        in every step. Rollouts that fail so are left out.
    """
    if not env.config.fixed_coefficient:
        # In the training environment, c would fall on bodies that the policy cannot move.
        env = env.with_task(replace(env.config, fixed_coefficient=True))
    state = env.reset(jax.random.fold_in(key, 1), coefficient=1.0, spread=True)
    parts, robots, per = [], [], -(-count // rollouts)
    owner = np.concatenate([np.full(g.count, i) for i, g in enumerate(env.groups)])
    skip = max(1, 64 // length)
    rng = np.random.default_rng(seed)
    for r in range(rollouts):
        # Rollouts far apart, so that states come from many moments of an episode.
        for s in range(skip):
            step_key = jax.random.fold_in(key, 1_000_003 + r * skip + s)
            state, trajectory = env.rollout(act, variables, state, step_key, length)
        good = np.argwhere(np.asarray(trajectory.finite))
        if not len(good):
            continue
        t, n = good[rng.choice(len(good), per, replace=per > len(good))].T
        parts.append(jax.tree.map(lambda x, t=t, n=n: np.asarray(x)[t, n], trajectory.observation))
        robots.append(owner[n])
    if not parts:
        return None
    bank = jax.tree.map(lambda *x: np.concatenate(x)[:count].astype(np.float32), *parts)
    return bank, np.concatenate(robots)[:count].astype(np.int32)


def require_state_bank(config: TrainConfig, sizes) -> None:
    """ValueError before the training if its states could not be saved at the end."""
    most = ARRAYS_LIMIT // (4 * (4 * sizes.joints + 3 * sizes.feet + 32))
    if config.state_bank > most:
        raise ValueError(
            f"state_bank is {config.state_bank}; expected at most {most:,} for these robots, as "
            "many as fit the file of an agent"
        )
