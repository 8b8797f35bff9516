"""A training run that begins with what another policy can do: imitation on the student's states.

A policy network can turn out too small after hours of training. Its knowledge need not be lost: a
network of another size learns to act like it, and PPO goes on from there. The student walks, and
the teacher says in every state that the student reaches what it would have done (DAgger, Ross et
al., 2011); with the teacher's states alone, the student's own errors would lead it to states that
it has never seen.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optax

from shapebody.agent.agent import Agent
from shapebody.arguments import require_engine, require_flag, require_integer, require_kind
from shapebody.configuration import to_json
from shapebody.networks.policy import Policy
from shapebody.task.env import Locomotion
from shapebody.training.config import MOST_STEPS, TrainConfig
from shapebody.training.trainer import Failures, Trainer
from shapebody.training.update import _apply

NOISE = 0.1
"""Standard deviation of the noise on the student's actions, in units of the action scale."""
KEPT = 8
"""Rollouts that the student learns from at a time: the newest, and the ones before it."""
RATES = (2e-3, 1e-5)
"""Adam's rate at the first and at the last step, linear between."""


def begin_run(
    config: TrainConfig,
    teacher: Agent,
    steps: int = 1_200_000,
    folder=None,
    engine: str = "auto",
    progress: bool = True,
) -> Trainer:
    """Begin a training run whose policy imitates that of an agent; `ppo.train` then continues it.

    The imitated actions are the teacher's means, on bodies f ~ U([-r, r]^d) with r ~ U(0, 1) and
    under the disturbances of c = 1. The run starts at c = 0 like any other, and climbs quickly. If
    the critic has the sizes of the teacher's, it starts as the teacher's.

    Args:
        config: the run. What imitation needs is taken from it: robots, seed, sizes of the policy,
            and sizes of batch and minibatch.
        teacher: an agent for the same robots.
        steps: environment steps of the imitation.
        folder: of the run; data/checkpoints/<name> if not given.
        engine: see `ppo.Trainer`.
        progress: print a line now and then.

    Returns:
        The trainer, whose state is saved in the folder; the first phase in its training.json says
        whom it imitated.

    Raises:
        ValueError: if there is a run in the folder, another one begins there, or the teacher is
            not for these robots; if the simulation of a robot always fails.
    """
    require_kind("config", config, TrainConfig, "such as TrainConfig.reduced(...)")
    require_kind("teacher", teacher, Agent, "load it with shapebody.load_agent(...)")
    require_integer("steps", steps, 1, MOST_STEPS)
    require_engine("engine", engine)
    require_flag("progress", progress)
    trainer = Trainer(config, folder, engine)
    names = {robot.name for robot in trainer.env.robots}
    if names != set(teacher.robots):
        raise ValueError(
            f"the teacher {teacher.name!r} is for {', '.join(sorted(teacher.robots))}, the run for "
            f"{', '.join(sorted(names))}; give an agent for the same robots"
        )
    with trainer.alone():
        saved = trainer.folder / "training.safetensors"
        if saved.exists():
            raise ValueError(
                f"there is a run in {trainer.folder} already; choose another name, or move "
                f"{saved.name} away to begin anew"
            )
        task = replace(config.task, fixed_coefficient=True, design_radius=(0.0, 1.0))
        env = Locomotion(trainer.env.robots, config.num_envs, engine, task)
        began = time.monotonic()
        policy, error = _imitated(config, env, teacher, trainer.learner.policy, steps, progress)
        trainer.start()
        learner = replace(trainer.learner, policy=policy)
        if config.critic == teacher.critic_config:
            learner = replace(learner, critic=jax.tree.map(jnp.asarray, teacher.critic))
        trainer.learner, trainer.behaviour = learner, policy
        trainer.phases[0]["imitated"] = {
            "agent": teacher.name,
            "policy_hash": teacher.policy_hash,
            "policy": to_json(teacher.policy_config),
            "agent_steps": teacher.metadata.get("steps"),
            "steps": max(1, steps // config.batch) * config.batch,
            "seconds": round(time.monotonic() - began, 1),
            "squared_error": round(error, 4),
        }
        trainer.save()
    return trainer


def _imitated(config, env, teacher, variables, steps, progress):
    """(variables of the student after imitation, its last mean squared error)."""
    student, master = Policy(config.policy), Policy(teacher.policy_config)
    iterations = max(1, steps // config.batch)
    per = config.minibatch_size // config.rollout_length
    minibatches = config.num_envs // per
    schedule = optax.linear_schedule(*RATES, iterations * KEPT * minibatches)
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))

    def act(policies, key, descriptions, observation):
        mean, _ = student.apply(policies[0], descriptions, observation)
        wanted, _ = master.apply(policies[1], descriptions, observation)
        noise = NOISE * jax.random.normal(key, mean.shape) * descriptions.joint_mask
        return mean + noise, wanted

    def loss(params, constants, batch):
        variables = {"params": params, **constants}
        mean, _ = _apply(student, variables, *(batch[x] for x in ("descriptions", "slot", "seen")))
        weight = batch["descriptions"].joint_mask[:, :1] * batch["valid"][..., None]
        return jnp.sum((mean - batch["wanted"]) ** 2 * weight) / jnp.maximum(jnp.sum(weight), 1.0)

    @jax.jit
    def learn(variables, state, batch, key):
        constants = {name: x for name, x in variables.items() if name != "params"}

        def one(carry, rows):
            params, state = carry
            part = jax.tree.map(lambda x: x[rows], batch)
            error, gradient = jax.value_and_grad(loss)(params, constants, part)
            updates, state = optimizer.update(gradient, state, params)
            return (optax.apply_updates(params, updates), state), error

        rows = jax.random.permutation(key, config.num_envs)[: minibatches * per]
        carry = variables["params"], state
        (params, state), errors = jax.lax.scan(one, carry, rows.reshape(minibatches, per))
        return {**variables, "params": params}, state, jnp.mean(errors)

    def by_env(tree):
        return jax.tree.map(lambda x: np.swapaxes(np.asarray(x), 0, 1), tree)

    key = jax.random.fold_in(jax.random.PRNGKey(config.seed), 17)
    state = env.reset(key, coefficient=1.0, spread=True)
    memory, optimizer_state = deque(maxlen=KEPT), optimizer.init(variables["params"])
    until, failures = time.monotonic(), Failures(env)
    for number in range(iterations):
        keys = jax.random.split(jax.random.fold_in(key, number), KEPT + 1)
        policies = variables, teacher.policy
        state, rollout = env.rollout(act, policies, state, keys[0], config.rollout_length)
        failures.add(rollout)
        memory.append(
            {
                "seen": by_env(rollout.observation),
                "descriptions": by_env(rollout.descriptions),
                "slot": by_env(rollout.slot),
                "valid": by_env(rollout.valid),
                "wanted": by_env(rollout.extra),
            }
        )
        for at, one in zip(range(KEPT), reversed([*memory] * KEPT), strict=False):
            variables, optimizer_state, error = learn(variables, optimizer_state, one, keys[at + 1])
        if progress and (time.monotonic() >= until or number + 1 == iterations):
            until = time.monotonic() + 10
            print(
                f"{(number + 1) * config.batch:>12,} of {iterations * config.batch:,} steps  "
                f"squared error {float(error):.4f}",
                flush=True,
            )
    return variables, float(error)
