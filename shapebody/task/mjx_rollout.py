"""Rollouts with MJX: policy, task and physics of all control steps in one compiled scan."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp

from shapebody.task.batch import Batch, RobotGroup
from shapebody.task.episode import Episode, Outcome
from shapebody.task.randomization import following_designs
from shapebody.task.trajectory import PolicyFunction, assembled, step_record


def compiled_rollout(batch: Batch, policy: PolicyFunction, length: int) -> Callable:
    """A rollout of `length` control steps: (params, state, physics, key) -> (state, physics,
    Trajectory), where `physics` is a tuple of one `PhysicsState` per group."""
    observe = jax.jit(batch.observe)

    def control_step(params, carry, key):
        state, physics = carry
        # Observe and act.
        state, observation = batch.observe(state)
        action, extra = policy(params, key, state.descriptions, observation)
        state, target, trunk, velocity = batch.control(state, action)

        # Physics, from pushed and clipped velocities.
        stepped, raw = [], []
        for group, one in zip(batch.groups, physics, strict=True):
            s, nu = group.slice, group.robot.num_actuators
            qvel = group.physics.velocity(one).at[:, :6].set(trunk[s])
            qvel = qvel.at[:, group.qvel_index].set(velocity[s, :nu])
            one = group.physics.with_velocity(one, qvel)
            one, *out = group.physics.step(one, target[s, :nu])
            stepped.append(one)
            raw.append(tuple(out))

        # Reward, ends of episodes, curriculum.
        state, outcome, following = batch.advance(state, tuple(raw))
        record = step_record(state, observation, action, extra, outcome)
        if batch.auto_reset:
            state, stepped = _restarted(batch, state, stepped, outcome, following)
        return (state, tuple(stepped)), record

    def rollout(params, state, physics, key):
        first = state.descriptions
        keys = jax.random.split(key, length)
        step = partial(control_step, params)
        (state, physics), records = jax.lax.scan(step, (state, physics), keys)
        _, last = observe(state)
        trajectory = assembled(records, first, state.descriptions, last, batch.auto_reset)
        return state, physics, trajectory

    return jax.jit(rollout)


def begin(group: RobotGroup, keys, designs, coefficients, streaks):
    """Start episodes in all environments of a group: (Episode [n], PhysicsState).

    keys, coefficients, streaks: [n]; designs: [n, d].
    """
    state, *physics = group.jitted_start(keys, jnp.asarray(designs), coefficients, streaks)
    return state, group.physics.init(*physics)


def _restarted(batch: Batch, state: Episode, physics, outcome: Outcome, following):
    """(state, physics) with new episodes where one has ended.

    A compiled function has no branches by environment: new episodes are computed for all of them,
    and used in some.
    """
    coefficient, streak, keys = following
    done = outcome.terminated | outcome.truncated
    fresh, restarted = [], []
    for group, one in zip(batch.groups, physics, strict=True):
        s = group.slice
        old = state.design[s, : group.space.dim]
        designs = following_designs(
            batch.config, keys[s], coefficient[s], old, outcome.terminated[s]
        )
        new, embodiment, qpos, qvel = group.start(keys[s], designs, coefficient[s], streak[s])
        fresh.append(new)
        restarted.append(group.physics.reset(one, done[s], embodiment, qpos, qvel))
    fresh = jax.tree.map(lambda *x: jnp.concatenate(x), *fresh)

    def choose(new, old):
        return jnp.where(done.reshape(done.shape + (1,) * (old.ndim - 1)), new, old)

    return jax.tree.map(choose, fresh, state), restarted
