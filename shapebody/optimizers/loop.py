"""What the search methods share: their result, and the loop of those that propose and learn.

    memory <- begin(start)
    repeat N times
        designs <- propose(memory)
        memory <- update(memory, their scores on a new minibatch of states)

`iterate` runs this loop. Random search, TuRBO, PSO, CEM, DE, ARS and GC-PFO are three functions for
it, each in its own module; VGDS, CMA-ES and BO have loops of their own.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from shapebody.arguments import require_array, require_integer, require_key, require_kind


class Search(NamedTuple):
    """What a method returns for S starts."""

    designs: jax.Array  # [S, d] found designs
    trajectory: jax.Array  # [N + 1, S, d] current (or best) design after every iteration
    history: jax.Array  # [N + 1, S] objective of the trajectory on minibatches
    evaluations: int  # designs that the method scored on a minibatch, per start


class Scored(NamedTuple):
    """The proposals of one iteration for one start, all scored on the same minibatch."""

    designs: jax.Array  # [P, d]
    values: jax.Array  # [P] objective, -inf where it is not finite
    gradients: jax.Array | None  # [P, d], zero where not finite; None unless asked for
    current: jax.Array  # [] objective of the current design


class Steps(NamedTuple):
    """A method as functions of its settings, for one start.

    The memory is a NamedTuple with the current design in its field `design` [d]. `begin(config,
    start, key)` gives the first memory, `propose(config, memory, key)` designs [P, d] to be
    scored, and `update(config, memory, scored, key)` the next memory.
    """

    begin: Callable[..., Any]
    propose: Callable[..., jax.Array]
    update: Callable[..., Any]
    gradients: bool = False


def iterate(objective, starts, key, config, steps: Steps, evaluations: int) -> Search:
    """Run `steps` for `config.iterations` iterations from every design of `starts` [S, d].

    Every iteration draws a new minibatch of states, the same as VGDS with that key and the same
    for all starts. A start's own random numbers follow from the key and the start design, so that
    its result does not depend on the other starts, to the last bit: each is searched by the same
    program, on a CPU as many at a time as there are cores.
    """
    starts = require_array("starts", starts, ("S", "d"))
    require_key("key", key)
    require_kind("steps", steps, Steps, "Steps(begin, propose, update)")
    require_integer("evaluations", evaluations)
    starts = jnp.asarray(starts)
    # Compiled here, once; threads that meet an uncompiled function would each compile it.
    run = _run.lower(objective, starts[0], key, config, steps).compile()
    # One population keeps two cores busy for little more than half of the time.
    side_by_side = cores() if jax.default_backend() == "cpu" else 1
    with ThreadPoolExecutor(side_by_side) as pool:
        found = pool.map(lambda start: jax.block_until_ready(run(objective, start, key)), starts)
        trajectory, history = (jnp.stack(values, axis=1) for values in zip(*found, strict=True))
    return Search(last_finite(trajectory, history), trajectory, history, evaluations)


def cores() -> int:
    """Number of processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@partial(jax.jit, static_argnames=("config", "steps"))
def _run(objective, start, key, config, steps: Steps):
    """Trajectory [N + 1, d] and history [N + 1] of one start [d]."""
    # Minibatches are the same for all starts; the method's own random numbers are the start's.
    batch_keys = jax.random.split(key, config.iterations + 1)
    begin_key, *_ = iteration_keys = jax.random.split(start_key(key, start), len(batch_keys))

    def iteration(memory, keys):
        batch_key, own_key = keys
        propose_key, update_key = jax.random.split(own_key)
        designs = steps.propose(config, memory, propose_key)
        rows = jnp.concatenate([memory.design[None], designs])
        states = objective.batch(batch_key)
        if steps.gradients:
            values, gradients = values_and_gradients(objective, rows, states)
            gradients = gradients[1:]
        else:
            values, gradients = objective(rows, states), None
        scored = Scored(designs, values[1:], gradients, values[0])
        return steps.update(config, memory, scored, update_key), (memory.design, values[0])

    memory = steps.begin(config, start, begin_key)
    keys = (batch_keys[:-1], iteration_keys[1:])
    memory, (trajectory, history) = jax.lax.scan(iteration, memory, keys)
    last = objective(memory.design[None], objective.batch(batch_keys[-1]))
    return jnp.concatenate([trajectory, memory.design[None]]), jnp.append(history, last)


def values_and_gradients(objective, designs, states):
    """Objective [P] of designs [P, d] and its gradients [P, d]; a broken gradient is zero."""

    def total(designs):
        values = objective(designs, states)
        return jnp.sum(values), values

    # Designs are independent, so the gradient of the sum holds the gradient of each.
    (_, values), gradients = jax.value_and_grad(total, has_aux=True)(designs)
    # One broken gradient would stay for good in Adam's moments and in covariances.
    return values, jnp.where(jnp.isfinite(gradients), gradients, 0.0)


@jax.jit
def score(objective, designs, key):
    """Objective [S, P] of designs [S, P, d] on one minibatch."""
    states = objective.batch(key)
    return jax.lax.map(lambda rows: objective(rows, states), designs)


def start_key(key, start):
    """A key that depends on the search's key and on the start design [d], bit by bit."""
    bits = jax.lax.bitcast_convert_type(jnp.asarray(start, jnp.float32), jnp.uint32)
    odd = 2 * jnp.arange(bits.size, dtype=jnp.uint32) + 1
    return jax.random.fold_in(key, jnp.sum(bits * odd, dtype=jnp.uint32))


def last_finite(trajectory, history):
    """The last designs [S, d] of a trajectory [N + 1, S, d] whose objective is finite.

    If it never is, this is the start.
    """
    rows = jnp.arange(len(history))[:, None]
    last = jnp.max(jnp.where(jnp.isfinite(history), rows, 0), axis=0)
    return jnp.take_along_axis(trajectory, last[None, :, None], axis=0)[0]


def initial_population(config, start, key):
    """Initial population [P, d] of PSO and DE: the start [d] first, the others uniform in the box.

    The paper does not name one; this is the textbooks'. The mean of such a population is the centre
    of the box, which is the reference design if that is f = 0: what PSO and DE gain by it, they
    would gain without a critic too. With `config.initial_std`, the others are Gaussian around the
    start instead.
    """
    shape = (config.particles, len(start))
    if config.initial_std is None:
        others = jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)
    else:
        others = jnp.clip(start + config.initial_std * jax.random.normal(key, shape), -1.0, 1.0)
    return others.at[0].set(start)
