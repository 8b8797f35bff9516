"""Rollouts with the native engine: a Python loop around one threaded physics call per step.

    act (compiled)  ->  physics of every robot (C, threaded)  ->  account (compiled)

The two compiled functions hold all of the task. Physics works in place on its own arrays, so that
between them there is nothing but copies of what they exchange.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from shapebody.task.batch import RESET_SLOTS, Batch, RobotGroup
from shapebody.task.config import TaskConfig
from shapebody.task.episode import Episode
from shapebody.task.randomization import draw_designs, following_designs
from shapebody.task.trajectory import PolicyFunction, assembled, step_record

# ------------------------------------------------------------------ one control step


def compiled_act(batch: Batch, policy: PolicyFunction) -> Callable:
    """The step before physics: (params, state, key) -> (the fields of the state that change,
    (joint targets, trunk velocities, joint velocities), observation, action, extra)."""

    def act(params, state, key):
        state, observation = batch.observe(state)
        action, extra = policy(params, key, state.descriptions, observation)
        state, *targets = batch.control(state, action)
        moved = {"clock": state.clock, "actions": state.actions}
        return moved, targets, observation, action, extra

    return jax.jit(act)


def compiled_account(batch: Batch) -> Callable:
    """The step after physics: `Batch.advance` of a state and what the engines returned.

    The state it returns lacks what an episode keeps, its design and descriptions: a compiled
    function would copy them.
    """

    def account(state: Episode, raw):
        state, *others = batch.advance(state, raw)
        return replace(state, design=None, descriptions=None), *others

    return jax.jit(account)


def control_step(batch: Batch, act, account, params, state: Episode, key, running=None):
    """One control step of all environments, and new episodes where one has ended.

    Args:
        act, account: from `compiled_act` and `compiled_account`.
        params, key: what the policy takes.
        state: Episode [N].
        running: bool [N], whose bodies are simulated; None for all.

    Returns:
        (state, StepRecord of NumPy arrays, Outcome of JAX arrays).
    """
    # Observe and act.
    moved, targets, observation, action, extra = act(params, state, key)
    target, trunk, velocity = map(np.asarray, targets)
    design, descriptions = state.design, state.descriptions
    state = replace(state, **moved)

    # Physics, from pushed and clipped velocities.
    raw = []
    for group in batch.groups:
        physics, s, nu = group.physics, group.slice, group.robot.num_actuators
        physics.qvel[:, :6] = trunk[s]
        physics.qvel[:, group.qvel_index] = velocity[s, :nu]
        qpos, qvel, sensordata, finite = physics.step(
            target[s, :nu], running=None if running is None else running[s]
        )
        raw.append((_single(qpos), _single(qvel), _single(sensordata), np.array(finite)))

    # Reward, ends of episodes, curriculum.
    state, outcome, following = account(state, tuple(raw))
    state = replace(state, design=design, descriptions=descriptions)
    record = jax.tree.map(np.asarray, step_record(state, observation, action, extra, outcome))
    done = record.terminated | record.truncated
    if batch.auto_reset and done.any():
        rows = np.flatnonzero(done)
        coefficient, streak, keys = (np.asarray(x)[rows] for x in following)
        fell = record.terminated[rows]
        state = restart(batch, state, rows, keys, None, coefficient, streak, fell)
    return state, record, outcome


def rollout(batch: Batch, act, account, observe, params, state: Episode, key, length: int):
    """`length` control steps of all environments: (state, Trajectory).

    Args:
        act, account: from `compiled_act` and `compiled_account`; observe: compiled `Batch.observe`.
        params, key: what the policy takes.
        state: Episode [N].
    """
    first = state.descriptions
    records = []
    for step_key in _step_keys(key, length):
        state, record, _ = control_step(batch, act, account, params, state, step_key)
        records.append(record)
    stacked = jax.tree.map(lambda *x: np.stack(x), *records)
    _, last = observe(state)
    return state, assembled(stacked, first, state.descriptions, last, batch.auto_reset)


@partial(jax.jit, static_argnums=1)
def _step_keys(key, length: int):
    """A key for each step of a rollout, [length]."""
    return jax.vmap(lambda t: jax.random.fold_in(key, t))(jnp.arange(length))


def _single(x):
    return np.asarray(x, np.float32)


# ------------------------------------------------------------------ new episodes


def begin(
    config: TaskConfig, group: RobotGroup, ids, keys, designs, coefficients, streaks, fell=None
) -> list[tuple[np.ndarray, Episode]]:
    """Start episodes in environments `ids` [R] of a group, and put their bodies into its physics.

    They are started RESET_SLOTS at a time, so that one compiled function serves any number.

    Args:
        keys, coefficients, streaks: [R], of the new episodes.
        designs: [R, d], or None to draw them.
        fell: bool [R], how the episodes ended that these follow; `designs` are then those of the
            ended ones (`following_designs`).

    Returns:
        (ids [at most RESET_SLOTS], Episode [RESET_SLOTS]) of each chunk, in the same order; slots
        beyond the ids mean nothing.
    """
    states = []
    keys, coefficients, streaks = (np.asarray(x) for x in (keys, coefficients, streaks))
    for at in range(0, len(ids), RESET_SLOTS):
        chosen = ids[at : at + RESET_SLOTS]
        m = len(chosen)
        # Unused slots repeat the first one.
        rows = np.concatenate([np.arange(at, at + m), np.full(RESET_SLOTS - m, at)])
        k, c = keys[rows], coefficients[rows]
        if designs is None:
            f = draw_designs(k, c, group.space.dim, config.design_radius)
        elif fell is not None:
            f = following_designs(config, k, c, designs[rows], fell[rows])
        else:
            f = designs[rows]
        state, *body = group.jitted_start(k, f, c, streaks[rows])
        embodiment, qpos, qvel = jax.tree.map(lambda x, m=m: np.asarray(x)[:m], body)
        group.physics.set_designs(chosen, embodiment)
        group.physics.set_state(chosen, qpos, qvel)
        states.append((chosen, state))
    return states


def restart(
    batch: Batch, state: Episode, rows, keys, designs, coefficient, streak, fell=None
) -> Episode:
    """The state with new episodes in environments `rows` [R], ascending; others go on.

    Args:
        keys, coefficient, streak: [R] NumPy arrays.
        designs: [R, D], padded to the largest robot's d, or None to draw them.
        fell: bool [R], whether the last episodes ended in a fall, after which a drawn design may be
            the same one again.
    """
    if designs is None and fell is not None:
        designs = np.asarray(state.design)[rows]
    for group in batch.groups:
        own = group.owned(rows)
        if not own.any():
            continue
        f = None if designs is None else designs[own, : group.space.dim]
        ids = rows[own] - group.first
        before = None if fell is None else fell[own]
        chunks = begin(
            batch.config, group, ids, keys[own], f, coefficient[own], streak[own], before
        )
        for chosen, fresh in chunks:
            # Slots beyond the chosen ones go nowhere: no environment has that number.
            at = np.full(RESET_SLOTS, len(state.step))
            at[: len(chosen)] = group.first + chosen
            state = _put(state, at, fresh)
    return state


@jax.jit
def _put(state: Episode, rows, fresh: Episode) -> Episode:
    """The state with `fresh` [R] in its `rows` [R]; rows that there are not are left out."""
    return jax.tree.map(lambda old, new: old.at[rows].set(new, mode="drop"), state, fresh)
