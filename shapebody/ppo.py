"""Training: PPO over randomized designs (Section 3.1, Appendix A), and policy evaluation.

One iteration collects a rollout of every environment, computes advantages with the current
critic, and takes several epochs of minibatch steps. A minibatch holds whole environments, so
that a design is encoded once for all its steps.

On a CPU, an actor thread collects the next rollout while the learner works on the last one.
The actor's policy is then one update old. The loss accounts for that as decoupled PPO does:
the trust region is around the policy at the start of the update, and the ratio of that policy
to the actor's enters as a truncated importance weight.

The second phase, policy evaluation, freezes the policy and trains critics alone on rollouts
over the full design space.
"""

import contextlib
import csv
import io
import json
import math
import os
import secrets
import shutil
import sys
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from shapebody.checkpoints import (
    Agent,
    atomic_write,
    chosen_folder,
    load_agent,
    load_arrays,
    read_metadata,
    require_agent,
    save_agent,
    save_arrays,
)
from shapebody.checks import (
    refuse,
    require_choice,
    require_engine,
    require_flag,
    require_integer,
    require_kind,
    require_list,
    require_name,
    require_number,
    require_path,
    require_seed,
    require_shape,
    shown,
)
from shapebody.files import alone_in, names_path
from shapebody.locomotion import Locomotion, TaskConfig, Trajectory
from shapebody.locomotion.observations import COMMAND, Observation
from shapebody.networks import (
    Critic,
    CriticConfig,
    Policy,
    PolicyConfig,
    entropy,
    initialize,
    log_prob,
    standardization,
)
from shapebody.paths import data_dir
from shapebody.robots import find, load_robot
from shapebody.runtime import keep_memory
from shapebody.stored import (
    ARRAYS_LIMIT,
    read_json,
    read_number,
    read_text,
)
from shapebody.stored import from_plain as _from_plain
from shapebody.stored import plain as _plain

MOST_STEPS = 10**15
"""Largest number of environment steps."""
SCALES = ("smoke", "reduced", "full")
"""Names of the sizes at which everything can be computed."""


@dataclass(frozen=True)
class TrainConfig:
    """A training run. Defaults are the paper's single-robot run (Appendix A, PPO table)."""

    name: str
    """Name of the agent and of its folder in data/checkpoints."""
    robots: tuple[str, ...]
    """Robots to train on, names or paths; environments are shared out evenly."""
    scale: str = "full"
    seed: int = 0

    policy: PolicyConfig = field(default_factory=PolicyConfig)
    critic: CriticConfig = field(default_factory=CriticConfig)
    standardize: bool = False
    """Standardize the network's inputs over the design distribution."""

    num_envs: int = 4096
    rollout_length: int = 64
    """Control steps per environment and iteration."""
    total_steps: int = 1_000_000_000
    minibatch_size: int = 16_384
    """Control steps per gradient step: whole environments times the rollout length. If it does not
    divide the batch (15,040 environments), every epoch leaves out some environments at random."""
    epochs: int = 10
    learning_rate: tuple[float, float] = (1.5e-3, 3e-4)
    """At the first and at the last step; linear between."""
    discount: float = 0.99
    gae_lambda: float = 0.7
    value_lambda: float | None = None
    """gae_lambda of the critic's targets, if not the same. With short rollouts and few gradient
    steps, a small one makes the critic learn slowly what lasts longer than 1 / (1 - lambda) steps.
    """
    cut_at_commands: bool = False
    """The policy's advantages end where the command changes, as if the episode were truncated. No
    action causes that change, so what the new command is worth is only noise to the policy."""
    clip_range: float = 0.1
    entropy_coefficient: float = 0.005
    max_gradient_norm: float = 3.0
    kl_threshold: float = 0.5
    """The rest of an iteration's updates is skipped once a minibatch exceeds this; inf: never."""

    task: TaskConfig = field(default_factory=TaskConfig)
    learn_policy: bool = True
    """False in the policy-evaluation phase: only the critic learns, at c = 1."""
    mean_actions: bool = False
    """Act without exploration noise, as in evaluation; only if the policy does not learn."""
    state_bank: int = 2048
    """States kept for design search."""

    def __post_init__(self):
        single = isinstance(self.robots, str | Path)
        robots = (self.robots,) if single else tuple(require_list("robots", self.robots, 1000))
        names = [_robot_name(robot) for robot in robots]
        robots = tuple(str(robot) for robot in robots)
        object.__setattr__(self, "robots", robots)
        if not robots:
            raise ValueError("robots is (); expected at least one name or path")
        if len(set(names)) < len(names):
            raise ValueError(
                f"robots is {robots!r}; expected robots of different names: a robot is known by "
                "the name of its file, so leave out repeated ones, or copy a file to another name"
            )
        require_name("name", self.name)
        counts = ("num_envs", "rollout_length", "total_steps", "minibatch_size", "epochs")
        for name in (*counts, "state_bank"):
            value = getattr(self, name)
            most = MOST_STEPS if name == "total_steps" else 2**24
            object.__setattr__(self, name, require_integer(name, value, 1, most))
        for name in ("discount", "gae_lambda", "value_lambda"):
            if name != "value_lambda" or self.value_lambda is not None:
                require_number(name, getattr(self, name), 0, 1)
        object.__setattr__(self, "seed", require_seed("seed", self.seed))
        for name, kind in (("policy", PolicyConfig), ("critic", CriticConfig)):
            hint = f"shapebody.{kind.__name__}.reduced(...)"
            require_kind(name, getattr(self, name), kind, hint)
        require_kind("task", self.task, TaskConfig, "shapebody.TaskConfig(...)")
        for name in ("standardize", "cut_at_commands", "learn_policy", "mean_actions"):
            require_flag(name, getattr(self, name))
        if self.learn_policy and self.mean_actions:
            raise ValueError(
                "mean_actions is True, but a policy learns from its exploration; expected "
                "learn_policy=False with it"
            )
        require_choice("scale", self.scale, SCALES)
        require_number("entropy_coefficient", self.entropy_coefficient, 0)
        for name in ("clip_range", "max_gradient_norm", "kl_threshold"):
            value = getattr(self, name)
            if not (name == "kl_threshold" and isinstance(value, float) and value == math.inf):
                require_number(name, value, above=0)
        rates = self.learning_rate
        if not isinstance(rates, tuple | list) or len(rates) != 2:
            expected = "two numbers of at least 0, for the first and for the last step"
            raise refuse("learning_rate", rates, expected)
        rates = tuple(require_number("a rate in learning_rate", rate, 0) for rate in rates)
        object.__setattr__(self, "learning_rate", rates)
        batch = self.num_envs * self.rollout_length
        if self.minibatch_size % self.rollout_length or self.minibatch_size > batch:
            raise ValueError(
                f"minibatch_size is {self.minibatch_size}; it must be a multiple of "
                f"rollout_length ({self.rollout_length}) and at most num_envs x rollout_length "
                f"({batch})"
            )

    @property
    def batch(self) -> int:
        """Control steps per iteration."""
        return self.num_envs * self.rollout_length

    @property
    def iterations(self) -> int:
        """Number of iterations of the whole run."""
        return max(1, self.total_steps // self.batch)

    @classmethod
    def full(cls, robot: str, **changes) -> "TrainConfig":
        """The paper's networks and single-robot hyperparameters, for a GPU."""
        name = f"{_default_name(robot, changes)}_full"
        task = TaskConfig.ancestors()
        return cls(**{"name": name, "robots": (robot,), "task": task, **changes})

    @classmethod
    def reduced(cls, robot: str, **changes) -> "TrainConfig":
        """Smaller networks and budget, for two CPU cores and some hours."""
        return cls(
            **{
                "name": _default_name(robot, changes),
                "robots": (robot,),
                "scale": "reduced",
                "policy": PolicyConfig.reduced(),
                "critic": CriticConfig.reduced(),
                "standardize": True,
                # More environments would bring more bodies into a batch, but fewer episodes to
                # each, and c moves by episodes.
                "num_envs": 256,
                "rollout_length": 32,
                "minibatch_size": 2048,
                "epochs": 3,
                "total_steps": 50_000_000,
                "learning_rate": (1e-3, 1e-4),
                "value_lambda": 0.95,
                "cut_at_commands": True,
                **changes,
            }
        )

    @classmethod
    def smoke(cls, robot: str, **changes) -> "TrainConfig":
        """Seconds of training: proves that the code runs and claims nothing."""
        tiny = {
            "name": f"{_default_name(robot, changes)}_smoke",
            "scale": "smoke",
            "policy": PolicyConfig.reduced(key_widths=(8, 8), core_widths=(16, 8)),
            "critic": CriticConfig.reduced(
                joint_key_widths=(8, 8), foot_key_widths=(8, 8), head_widths=(16,)
            ),
            "num_envs": 16,
            "rollout_length": 8,
            "minibatch_size": 64,
            "epochs": 2,
            "total_steps": 512,
            "state_bank": 64,
        }
        return cls.reduced(robot, **{**tiny, **changes})

    @classmethod
    def at_scale(cls, scale: str, robot: str, **changes) -> "TrainConfig":
        """`smoke`, `reduced` or `full` by name."""
        require_choice("scale", scale, SCALES)
        return getattr(cls, scale)(robot, **changes)


def _default_name(robot: str, changes: dict) -> str:
    """Name of an agent: its robots' names, or those of their files, joined with "+"."""
    robots = changes.get("robots", (robot,))
    robots = (robots,) if isinstance(robots, str | Path) else require_list("robots", robots)
    return "+".join(_robot_name(name) for name in robots)


def _robot_name(name_or_path) -> str:
    """The name of a robot that is given by name or file, without reading the file."""
    path = require_path("robot", name_or_path)
    return require_name("the name of the robot's file", path.stem)


def _located(robot: str) -> str:
    """A robot as runs store it: a shipped one by name, a file by its absolute path, so that it is
    the same robot in every working directory."""
    try:
        path = find(robot)
    except (ValueError, OSError):
        return robot  # which `load_robot` reports
    # Links are not followed: the robot's name is that of the file as it was given.
    return robot if path == data_dir() / "robots" / f"{robot}.xml" else os.path.abspath(path)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Learner:
    """Everything the learner changes."""

    policy: Any  # variables of Policy.apply
    critic: Any  # variables of Critic.apply
    policy_optimizer: Any
    critic_optimizer: Any
    iteration: jax.Array  # [] int32, finished iterations


# ---------------------------------------------------------------------------- the algorithm


def advantages(reward, value, last_value, terminated, truncated, discount, gae_lambda):
    """Generalized advantage estimation over [N, T] (last_value [N]); returns [N, T].

    A terminated episode is worth nothing afterwards, whatever `truncated` says there. A truncated
    one would have gone on: its last state's value stands for that of the next state, one control
    step later.
    """
    for name, array in (("reward", reward), ("value", value), ("terminated", terminated)):
        require_shape(name, array, ("N", "T"))
    for name, array in (("value", value), ("terminated", terminated), ("truncated", truncated)):
        require_shape(name, array, reward.shape)
    require_shape("last_value", last_value, reward.shape[:1])
    done = terminated | truncated
    following = jnp.concatenate([value[:, 1:], last_value[:, None]], 1)
    following = jnp.where(truncated, value, following)
    following = jnp.where(terminated, 0.0, following)
    error = reward + discount * following - value

    def backward(advantage, inputs):
        error, done = inputs
        advantage = error + discount * gae_lambda * jnp.where(done, 0.0, advantage)
        return advantage, advantage

    _, result = jax.lax.scan(backward, jnp.zeros_like(last_value), (error.T, done.T), reverse=True)
    return result.T


def command_changes(observation: Observation, last_observation: Observation):
    """Whether the command of the next step is another one, bool[N, T].

    observation: [N, T, ...]; last_observation: [N, ...], after the last step.
    """
    commands = observation.general[..., COMMAND]
    last = last_observation.general[:, None, COMMAND]
    following = jnp.concatenate([commands[:, 1:], last], 1)
    return jnp.any(following != commands, -1)


def make_policy_function(policy: Policy, mean_actions: bool = False):
    """The policy as `Locomotion.rollout` wants it; extra is the log density of the action."""
    require_kind("policy", policy, Policy, "shapebody.Policy(...)")
    require_flag("mean_actions", mean_actions)

    def act(variables, key, descriptions, observation):
        mean, std = policy.apply(variables, descriptions, observation)
        noise = 0.0 if mean_actions else jax.random.normal(key, mean.shape)
        action = mean + std * noise * descriptions.joint_mask
        return action, log_prob(mean, std, action, descriptions.joint_mask)

    return act


def _at_steps(embedding, slot):
    """Spread an embedding [B, 2, ...] of the two designs of a rollout over its steps [B, T]."""

    def spread(x):
        chosen = slot.reshape(slot.shape + (1,) * (x.ndim - 2)) > 0
        return jnp.where(chosen, x[:, 1, None], x[:, 0, None])

    return jax.tree.map(spread, embedding)


def _apply(network, variables, descriptions, slot, observation):
    """Network output at all steps [B, T], encoding each design once. descriptions: [B, 2]."""
    embedding = network.apply(variables, descriptions, method="embed")
    # The masks belong to the robot, not to the design, so either slot will do.
    masks = jax.tree.map(lambda x: x[:, :1], descriptions)
    return network.apply(variables, _at_steps(embedding, slot), masks, observation, method="act")


def make_update(config: TrainConfig, policy: Policy, critic: Critic):
    """The learner's iteration: (Learner, Trajectory, key) -> (Learner, metrics)."""
    require_kind("config", config, TrainConfig, "such as TrainConfig.reduced(...)")
    require_kind("policy", policy, Policy, "shapebody.Policy(...)")
    require_kind("critic", critic, Critic, "shapebody.Critic(...)")
    optimizer = optax.chain(
        optax.clip_by_global_norm(config.max_gradient_norm), optax.scale_by_adam(eps=1e-5)
    )
    first_rate, last_rate = config.learning_rate
    envs_per_minibatch = config.minibatch_size // config.rollout_length
    minibatches = config.num_envs // envs_per_minibatch

    def policy_loss(params, constants, batch):
        variables = {"params": params, **constants}
        mean, std = _apply(
            policy, variables, batch["descriptions"], batch["slot"], batch["observation"]
        )
        mask = batch["descriptions"].joint_mask[:, :1]
        logp = log_prob(mean, std, batch["action"], mask)
        weight = batch["valid"] / jnp.maximum(jnp.sum(batch["valid"]), 1.0)
        # Steps that do not count were computed with another body and may be anything.
        log_ratio = jnp.where(batch["valid"] > 0, logp - batch["log_prob"], 0.0)
        ratio = jnp.exp(jnp.clip(log_ratio, -20.0, 20.0))
        clipped = jnp.clip(ratio, 1 - config.clip_range, 1 + config.clip_range)
        advantage = batch["advantage"]
        gain = jnp.minimum(ratio * advantage, clipped * advantage) * batch["importance"]
        randomness = jnp.sum(entropy(std, mask) * weight)
        loss = -jnp.sum(gain * weight) - config.entropy_coefficient * randomness
        real = jnp.sum(mask * weight[..., None])
        return loss, {
            "kl": jnp.sum((ratio - 1 - log_ratio) * weight),
            "clipped": jnp.sum((jnp.abs(ratio - 1) > config.clip_range) * weight),
            "std": jnp.sum(std * mask * weight[..., None]) / real,
        }

    def critic_loss(params, constants, batch):
        variables = {"params": params, **constants}
        values = _apply(
            critic, variables, batch["descriptions"], batch["slot"], batch["observation"]
        )
        weight = batch["valid"] / jnp.maximum(jnp.sum(batch["valid"]), 1.0)
        error = jnp.mean((values - batch["target"][..., None]) ** 2, -1)
        return 0.5 * jnp.sum(error * weight)

    def step(variables, state, gradient, rate):
        updates, new_state = optimizer.update(gradient, state)
        params = jax.tree.map(lambda p, u: p - rate * u, variables["params"], updates)
        # One broken minibatch must not spoil the weights and Adam's memory for good.
        finite = jnp.isfinite(optax.tree.norm(gradient))
        params, state = jax.tree.map(
            lambda new, old: jnp.where(finite, new, old),
            (params, new_state),
            (variables["params"], state),
        )
        return {**variables, "params": params}, state

    def constants(variables):
        return {k: v for k, v in variables.items() if k != "params"}

    def minibatch_step(rate, batch, learner: Learner, stopped):
        loss, gradient = jax.value_and_grad(critic_loss)(
            learner.critic["params"], constants(learner.critic), batch
        )
        new_critic, critic_state = step(learner.critic, learner.critic_optimizer, gradient, rate)
        metrics = {"value_loss": loss, "updates": jnp.ones(())}
        new_policy, policy_state = learner.policy, learner.policy_optimizer
        if config.learn_policy:
            (_, more), gradient = jax.value_and_grad(policy_loss, has_aux=True)(
                learner.policy["params"], constants(learner.policy), batch
            )
            new_policy, policy_state = step(new_policy, policy_state, gradient, rate)
            metrics |= more
            # Not "kl > threshold", which would let a NaN pass.
            stopped = ~(metrics["kl"] <= config.kl_threshold)
        learner = replace(
            learner,
            policy=new_policy,
            critic=new_critic,
            policy_optimizer=policy_state,
            critic_optimizer=critic_state,
        )
        return learner, stopped, metrics

    @jax.jit
    def update(learner: Learner, trajectory: Trajectory, key):
        def by_env(x):
            return jnp.swapaxes(x, 0, 1)

        observation = jax.tree.map(by_env, trajectory.observation)
        descriptions = jax.tree.map(by_env, trajectory.descriptions)
        slot, valid = by_env(trajectory.slot), by_env(trajectory.valid)
        reward = by_env(trajectory.reward)
        value = jnp.mean(_apply(critic, learner.critic, descriptions, slot, observation), -1)
        latest = jax.tree.map(lambda x: x[:, 1], descriptions)
        last_value = jnp.mean(critic.apply(learner.critic, latest, trajectory.last_observation), -1)
        terminated, truncated = by_env(trajectory.terminated), by_env(trajectory.truncated)

        def estimate(truncated, gae_lambda):
            return advantages(
                reward, value, last_value, terminated, truncated, config.discount, gae_lambda
            )

        value_lambda = config.gae_lambda if config.value_lambda is None else config.value_lambda
        target = estimate(truncated, value_lambda) + value
        cut = truncated
        if config.cut_at_commands:
            cut |= command_changes(observation, trajectory.last_observation)
        advantage = estimate(cut, config.gae_lambda)
        total = jnp.sum(valid)

        def moments(x):
            mean = jnp.sum(x * valid) / total
            return mean, jnp.sum((x - mean) ** 2 * valid) / total

        mean, variance = moments(advantage)
        action, behaviour = by_env(trajectory.action), by_env(trajectory.extra)
        batch = {
            "observation": observation,
            "descriptions": descriptions,
            "slot": slot,
            "valid": valid,
            "action": action,
            "target": target,
            "advantage": (advantage - mean) / (jnp.sqrt(variance) + 1e-8),
        }
        if config.learn_policy:
            policy_mean, std = _apply(policy, learner.policy, descriptions, slot, observation)
            proximal = log_prob(policy_mean, std, action, descriptions.joint_mask[:, :1])
            batch["log_prob"] = proximal
            batch["importance"] = jnp.minimum(jnp.exp(proximal - behaviour), 2.0)

        progress = jnp.minimum(learner.iteration / config.iterations, 1.0)
        rate = first_rate + (last_rate - first_rate) * progress
        names = ["value_loss", "updates"] + ["kl", "clipped", "std"] * config.learn_policy

        def one(carry, rows):
            learner, stopped = carry
            part = jax.tree.map(lambda x: x[rows], batch)
            # Once stopped, the rest of the iteration is skipped.
            learner, stopped, metrics = jax.lax.cond(
                stopped,
                lambda learner: (learner, stopped, {name: jnp.zeros(()) for name in names}),
                lambda learner: minibatch_step(rate, part, learner, stopped),
                learner,
            )
            return (learner, stopped), metrics

        orders = jax.vmap(lambda k: jax.random.permutation(k, config.num_envs))(
            jax.random.split(key, config.epochs)
        )
        orders = orders[:, : minibatches * envs_per_minibatch]
        rows = orders.reshape(config.epochs * minibatches, envs_per_minibatch)
        (learner, _), metrics = jax.lax.scan(one, (learner, jnp.asarray(False)), rows)
        updates = jnp.maximum(jnp.sum(metrics["updates"]), 1.0)
        metrics = {name: jnp.sum(x) / updates for name, x in metrics.items()}
        _, residual = moments(target - value)
        _, spread = moments(target)
        metrics |= {
            "learning_rate": rate,
            "updates": updates,
            "explained_variance": 1 - residual / jnp.maximum(spread, 1e-8),
            "value": jnp.sum(value * valid) / total,
        }
        return replace(learner, iteration=learner.iteration + 1), metrics

    def start(policy_variables, critic_variables) -> Learner:
        return Learner(
            policy=policy_variables,
            critic=critic_variables,
            policy_optimizer=optimizer.init(policy_variables["params"]),
            critic_optimizer=optimizer.init(critic_variables["params"]),
            iteration=jnp.zeros((), jnp.int32),
        )

    return update, start


# ---------------------------------------------------------------------------- the run


CURVE = (
    "steps seconds return length tracking_error coefficient reward non_finite kl clipped std "
    "value_loss explained_variance learning_rate steps_per_second"
).split()
"""Columns of the learning curve. return, length, tracking_error (m/s): means over the episodes that
ended since the last row; coefficient and reward: means over steps; non_finite: episodes that
were ended because the simulation became invalid."""

CURVE_INTERVAL = 10
"""Iterations per row of the learning curve."""


class Trainer:
    """A resumable training run.

    Everything that determines its future is in `training.safetensors` in the agent's folder,
    written after every iteration: a killed run continues as if nothing had happened and
    repeats at most one rollout. Beside it, `training.csv` is the learning curve so far; the
    agent itself and its `curve.csv` change only in `save_agent`. Of several trainers in a folder,
    one writes at a time (`alone`), and none replaces a state that another has written since it
    last read or wrote its own.

    Args:
        config: the run.
        folder: the agent's folder; data/checkpoints/<name> if not given.
        engine: "native", "mjx" or "auto": that of the run in the folder or, if there is none, the
            one that `Locomotion` chooses.
        policy: variables of a frozen policy, for the policy-evaluation phase.

    Raises:
        ValueError: if the run in the folder has another engine, or the state bank of `config` is
            too large for the file of an agent.
    """

    def __init__(self, config: TrainConfig, folder=None, engine: str = "auto", policy=None):
        _require_run(config, engine)
        if policy is not None and not (isinstance(policy, Mapping) and "params" in policy):
            raise refuse("policy", policy, "variables of a Policy, such as agent.policy")
        keep_memory()
        robots = tuple(_located(robot) for robot in config.robots)
        config = config if robots == config.robots else replace(config, robots=robots)
        self.config = config
        self.folder = chosen_folder(folder, config.name)
        robots = [load_robot(name) for name in config.robots]
        task = config.task
        if not config.learn_policy:
            task = replace(task, fixed_coefficient=True)
        engine = _engine(self.folder, engine)
        self.env = Locomotion(robots, config.num_envs, engine=engine, config=task)
        _check_state_bank(config, self.env.sizes)
        self.policy, self.critic = Policy(config.policy), Critic(config.critic)
        self.update, start = make_update(config, self.policy, self.critic)
        self.act = make_policy_function(self.policy, config.mean_actions)
        keys = jax.random.split(jax.random.PRNGKey(config.seed), 4)
        self.key = keys[0]
        constants = self._constants(keys[1]) if config.standardize else None
        if policy is None:
            policy = initialize(self.policy, keys[2], constants)
        self.learner = start(policy, initialize(self.critic, keys[3], constants))
        self.behaviour = self.learner.policy
        self.seconds = 0.0
        self.phases = []
        self.state = None
        self.saved_physics = None
        self.in_step = True  # whether the engine is where `state` is
        self.holds_lock = False
        self.known = None  # `_version` of the state on disk that this trainer read or wrote

    def _constants(self, key):
        """Input standardization over the designs of all robots."""
        batches = []
        for i, robot in enumerate(self.env.robots):
            keys = jax.random.fold_in(key, i)
            f = jax.random.uniform(keys, (512, robot.design_dim), minval=-1.0, maxval=1.0)
            batches.append(self.env.descriptions(i, f))
        return standardization(*batches)

    # -------------------------------------------------------------- state on disk

    @property
    def steps(self) -> int:
        """Environment steps the learner has consumed."""
        return int(self.learner.iteration) * self.config.batch

    def _everything(self):
        return {
            "learner": self.learner,
            "behaviour": self.behaviour,
            "state": self.state,
            "physics": self.saved_physics,
            "seconds": np.float64(self.seconds),
        }

    @contextlib.contextmanager
    def alone(self):
        """Keep other trainers out of the folder while the block runs; blocks may be nested.

        Raises:
            ValueError: if another process, or another trainer, is at work there.
        """
        if self.holds_lock:
            yield
            return
        created = not self.folder.exists()
        self.folder.mkdir(parents=True, exist_ok=True)
        try:
            with alone_in(self.folder):
                self.holds_lock = True
                yield
        finally:
            self.holds_lock = False
            if created:
                with contextlib.suppress(OSError):  # unless something was written there
                    self.folder.rmdir()

    def _require_latest(self) -> None:
        """ValueError if the state on disk is another than this trainer read or wrote last."""
        if _version(self.folder) != self.known:
            raise ValueError(
                f"the run in {self.folder} has changed since this trainer read it: another one has "
                "trained there; call start() to go on from its state, or choose another name or "
                "folder"
            )

    def save(self) -> None:
        """Write the training state.

        Raises:
            ValueError: if another trainer has written one since this trainer's own.
        """
        with self.alone():
            self._require_latest()
            path = self.folder / "training.json"
            text = json.dumps(self.phases, indent=1) + "\n"
            if not path.exists() or path.read_bytes() != text.encode():
                atomic_write(path, text)
            save_arrays(self.folder / STATE_FILES[0], self._everything())
            self.known = _version(self.folder)

    def start(self) -> bool:
        """Resume from the folder, or start afresh; True if resumed.

        Raises:
            FileNotFoundError: if the run in the folder lacks its training.json.
            ValueError: if the run in the folder is of another configuration, or its files are
                damaged.
        """
        path = self.folder / "training.safetensors"
        # Before anything is read: what another trainer writes meanwhile is noticed in `run`.
        self.known = _version(self.folder)
        resumed = path.exists()
        if resumed:
            # Before the arrays are read, whose shapes depend on the configuration.
            steps = _iterations(self.folder) * self.config.batch
            about = self.folder / "training.json"
            self.phases = _continued(about, self.config, steps, self.env.robots)
        coefficient = 0.0 if self.config.learn_policy else 1.0
        self.state = self.env.reset(self.key, coefficient=coefficient, spread=True)
        native = self.env.engine == "native"
        self.saved_physics = self.env.physics_arrays() if native else self.env.physics_state
        if not resumed:
            robots = {robot.name: robot.hash for robot in self.env.robots}
            first = {"from_step": 0, "config": _plain(self.config)}
            self.phases = [first | {"robots": robots, "engine": self.env.engine}]
            return False
        saved = load_arrays(path, self._everything())
        self.learner, self.behaviour = saved["learner"], saved["behaviour"]
        self.state, self.seconds = saved["state"], float(saved["seconds"])
        self.saved_physics = saved["physics"]
        self.in_step = False
        return True

    def agent(self, states=None) -> Agent:
        """The agent as trained so far."""
        config = self.config
        metadata = {
            "config": _plain(config),
            "phases": self.phases,
            "scale": config.scale,
            "engine": self.env.engine,
            "steps": self.steps,
            "seconds": round(self.seconds, 1),
        }
        return Agent(
            name=config.name,
            robots=tuple(robot.name for robot in self.env.robots),
            sizes=self.env.sizes,
            policy_config=config.policy,
            critic_config=config.critic,
            policy=self.learner.policy,
            critic=self.learner.critic,
            states=None if states is None else states[0],
            state_robots=None if states is None else states[1],
            metadata=metadata,
        )

    def save_agent(self, folder=None) -> Agent:
        """Write the agent as trained so far, with a fresh state bank and its learning curve.

        folder: where to; the run's own if not given.
        """
        folder = self.folder if folder is None else require_path("folder", folder)
        agent = self.agent(self.state_bank())
        rows, _ = _rows(self.folder / "training.csv")
        save_agent(agent, folder, rows or None)
        return agent

    # -------------------------------------------------------------- the loop

    def _collect(self, behaviour, state, number):
        key = jax.random.fold_in(self.key, 2 * number)
        return self.env.rollout(self.act, behaviour, state, key, self.config.rollout_length)

    def last_iteration(self, max_steps=None) -> int:
        """Number of finished iterations at which `run` ends with that budget."""
        if max_steps is not None:
            require_integer("max_steps", max_steps, 0, MOST_STEPS)
        last = self.config.iterations
        return last if max_steps is None else min(last, max_steps // self.config.batch)

    def run(self, max_steps=None, max_seconds=None, progress=True, curve_interval=None) -> None:
        """Train until the configured number of steps, or until a budget is used up.

        Args:
            max_steps: stop once this many steps in all have been consumed.
            max_seconds: stop after this many seconds of this call.
            progress: print a line every few seconds.
            curve_interval: iterations per row of the learning curve, CURVE_INTERVAL if not given.

        Raises:
            ValueError: if another process trains in the same folder, or has trained there since
                `start`; if the simulation of a robot always fails.
        """
        _require_budget(max_steps, max_seconds, progress)
        if curve_interval is not None:
            require_integer("curve_interval", curve_interval, 1)
        config = self.config
        number, last = int(self.learner.iteration), self.last_iteration(max_steps)
        if number >= last:
            return
        if not self.in_step:
            if self.env.engine == "native":
                self.env.restore(self.state, self.saved_physics)
            else:
                self.env.physics_state = self.saved_physics
        self.in_step = False
        # On an accelerator there is nothing to overlap: the device does one thing at a time.
        overlap = self.env.engine == "native"
        failures = Failures(self.env)
        with self.alone(), ThreadPoolExecutor(1) as actor:
            self._require_latest()
            curve = _Curve(self.folder / "training.csv", self.steps)
            state, trajectory = self._collect(self.behaviour, self.state, number)
            mark = time.monotonic()
            until = mark + (math.inf if max_seconds is None else max_seconds)
            report = _Report(last * config.batch, until, progress)
            while True:
                # A snapshot from which the rollout below can be repeated.
                self.state, self.behaviour = state, self.learner.policy
                if overlap:
                    self.saved_physics = self.env.physics_arrays()
                    pending = actor.submit(self._collect, self.behaviour, state, number + 1)
                key = jax.random.fold_in(self.key, 2 * number + 1)
                self.learner, metrics = self.update(self.learner, trajectory, key)
                metrics = {name: float(x) for name, x in metrics.items()}
                if overlap:
                    state, following = pending.result()
                else:
                    self.behaviour = self.learner.policy
                    self.saved_physics = self.env.physics_state
                number += 1
                now = time.monotonic()
                self.seconds, elapsed, mark = self.seconds + now - mark, now - mark, now
                failures.add(trajectory)
                curve.add(trajectory, metrics, elapsed, config.batch)
                if number % (curve_interval or CURVE_INTERVAL) == 0:
                    curve.write(self.steps, self.seconds)
                report.show(self.steps, curve)
                self.save()
                if number >= last or now >= until:
                    break
                if not overlap:
                    state, following = self._collect(self.behaviour, state, number)
                trajectory = following
        if curve.count:
            curve.write(self.steps, self.seconds)
        report.end()

    def state_bank(self, rollouts: int = 8):
        """States from rollouts of the policy on random designs at c = 1 (Section 3.2).

        Designs and episodes are those of the task: the policy-evaluation phase, from which the
        shipped banks come, has f ~ U([-r, r]^d) with r ~ U(0, 1) and short episodes.

        Returns (Observation [M, ...] of numpy arrays, robot index int32[M]); None if the
        simulation fails in every step. Rollouts that fail so are left out.
        """
        require_integer("rollouts", rollouts, 1, 100_000)
        count = self.config.state_bank
        env = self.env
        if not env.config.fixed_coefficient:
            # In the training environment, c would fall on bodies that the policy cannot move.
            env = env.with_task(replace(env.config, fixed_coefficient=True))
        self.in_step = False
        state = env.reset(jax.random.fold_in(self.key, 1), coefficient=1.0, spread=True)
        length = self.config.rollout_length
        parts, robots, per = [], [], -(-count // rollouts)
        owner = np.concatenate([np.full(g.count, i) for i, g in enumerate(env.groups)])
        skip = max(1, 64 // length)
        rng = np.random.default_rng(self.config.seed)
        for r in range(rollouts):
            # Rollouts far apart, so that states come from many moments of an episode.
            for s in range(skip):
                key = jax.random.fold_in(self.key, 1_000_003 + r * skip + s)
                state, trajectory = env.rollout(self.act, self.learner.policy, state, key, length)
            good = np.argwhere(np.asarray(trajectory.finite))
            if not len(good):
                continue
            t, n = good[rng.choice(len(good), per, replace=per > len(good))].T
            parts.append(
                jax.tree.map(lambda x, t=t, n=n: np.asarray(x)[t, n], trajectory.observation)
            )
            robots.append(owner[n])
        if not parts:
            return None
        bank = jax.tree.map(lambda *x: np.concatenate(x)[:count].astype(np.float32), *parts)
        return bank, np.concatenate(robots)[:count].astype(np.int32)


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


def _check_state_bank(config: TrainConfig, sizes) -> None:
    """ValueError before the training if its states could not be saved at the end."""
    most = ARRAYS_LIMIT // (4 * (4 * sizes.joints + 3 * sizes.feet + 32))
    if config.state_bank > most:
        raise ValueError(
            f"state_bank is {config.state_bank}; expected at most {most:,} for these robots, as "
            "many as fit the file of an agent"
        )


def _version(folder: Path):
    """What changes whenever the state in a folder is written; None where there is none."""
    try:
        status = (folder / "training.safetensors").stat()
        return status.st_ino, status.st_mtime_ns, status.st_size
    except FileNotFoundError:
        return None


def train(
    config: TrainConfig,
    folder=None,
    progress: bool = True,
    max_steps: int | None = None,
    max_seconds: float | None = None,
    engine: str = "auto",
    state_only: bool = False,
    replace: bool = False,
) -> Agent | None:
    """Train an agent, or continue its training, and save it.

    An interrupt (Ctrl-C) ends the call early, with the agent of the last iteration; before the
    first one there is nothing to save, and KeyboardInterrupt is raised. A call that trains nothing,
    because the run is at its end or at `max_steps`, leaves an agent of at least as many steps in
    the folder as it is, with the critic that `train_critic` may have given it.

    Args:
        config: the run, for example `TrainConfig.reduced("unitree_go2")`. If it is the default of
            its scale, a run in the folder goes on with the settings that it has (`as_continued`).
        folder: where the agent is kept; data/checkpoints/<name> by default. A run that was
            stopped there is continued exactly where it was.
        progress: print return, tracking error, curriculum coefficient, speed and time left.
        max_steps: stop once this many steps in all have been consumed.
        max_seconds: stop after this many seconds. After either, the run can be continued.
        engine: "native", "mjx" or "auto", see `Trainer`.
        state_only: leave the agent in the folder as it is; the run can be annealed later.
        replace: replace the agent in the folder even if it has more steps than the run, or if
            nothing was trained.

    Returns:
        The agent in the folder, with its state bank; None with `state_only`.

    Raises:
        ValueError: if `max_steps` is less than one iteration, if the agent in the folder has more
            steps than the run that is to go on, or if the run there cannot be continued with
            `config`.
    """
    _require_run(config, engine)
    _require_budget(max_steps, max_seconds, progress)
    for name, value in (("state_only", state_only), ("replace", replace)):
        require_flag(name, value)
    given = {"robots": config.robots, "name": config.name}
    if config == TrainConfig.at_scale(config.scale, config.robots[0], **given):
        config = as_continued(config, folder)
    if max_steps is not None and max_steps < config.batch:
        raise ValueError(
            f"max_steps is {max_steps}; one iteration is {config.batch} steps: give at least as "
            "many, or a configuration with fewer environments"
        )
    trainer = Trainer(config, folder, engine)
    # From reading the state to saving the agent: what another call has written meanwhile would be
    # lost.
    with trainer.alone():
        trainer.start()
        begun = trainer.steps
        if not (state_only or replace) and begun < trainer.last_iteration(max_steps) * config.batch:
            others = (
                ", state_only=True (--state-only) to leave it, or choose another name or folder"
            )
            _keep_agent(trainer.folder, begun, others)
            _keep_critic(trainer.folder, others)
        _run(trainer, progress, max_steps, max_seconds)
        if state_only:
            return None
        if not replace and trainer.steps == begun <= (_agent_steps(trainer.folder) or 0):
            return load_agent(trainer.folder)
        return trainer.save_agent()


STATE_FILES = ("training.safetensors", "training.json", "training.csv")
"""A run in its folder: its state, its configurations and its learning curve."""


def _require_run(config, engine: str = "auto") -> None:
    hint = 'for example TrainConfig.reduced("unitree_go2")'
    require_kind("config", config, TrainConfig, hint)
    require_engine("engine", engine)


def _require_budget(max_steps, max_seconds, progress) -> None:
    if max_steps is not None:
        require_integer("max_steps", max_steps, 0, MOST_STEPS)
    if max_seconds is not None:
        require_number("max_seconds", max_seconds, 0)
    require_flag("progress", progress)


def _metadata(folder: Path) -> dict | None:
    """Metadata of the agent in a folder: None if there is no agent, {} if they are unreadable."""
    try:
        return read_metadata(folder)
    except (ValueError, OSError):
        return {}


def _agent_steps(folder: Path) -> int | None:
    """Steps of the agent in a folder: None if there is no agent, 0 if it does not say."""
    metadata = _metadata(folder)
    return None if metadata is None else metadata.get("steps", 0)


def _keep_agent(folder: Path, steps: int, others: str = "") -> None:
    """Raise ValueError if the agent in a folder has more steps than the one to replace it."""
    kept = _agent_steps(folder)
    # A run that is about to begin replaces no agent, not even one of unknown steps.
    if kept is not None and (kept > steps or steps == 0):
        raise ValueError(
            f"the agent in {folder} has {kept:,} steps, the run that would replace it {steps:,}; "
            f"pass replace=True (--replace) to replace it{others}"
        )


def _keep_critic(folder: Path, others: str = "") -> None:
    """Raise ValueError if the agent in a folder has a critic from policy evaluation."""
    if "policy_evaluation" in (_metadata(folder) or {}):
        raise ValueError(
            f"the agent in {folder} has a critic from policy evaluation (sharpen), which the run "
            "that would replace the agent does not have; pass replace=True (--replace) to replace "
            f"it, and sharpen it again afterwards{others}"
        )


def anneal(
    name: str,
    steps: int = 1_640_000,
    last_rate: float = 2e-5,
    folder=None,
    progress: bool = True,
    max_seconds: float | None = None,
    engine: str = "auto",
    replace: bool = False,
) -> Agent | None:
    """Save a good agent from a run that is not at its end.

    A large learning rate learns fast and leaves the policy noisy; lowering it brings a gain that
    comes only once. So a copy of the run goes on for some steps while the rate falls, and the
    agent is the copy's. The run itself stays where it is and can go on as fast as before.

    Args:
        name: of the agent whose run is in data/checkpoints/<name>.
        steps: environment steps of the copy.
        last_rate: its learning rate at the end; linear from the run's present one.
        folder: of the run, instead of data/checkpoints/<name>. The agent is saved there; the copy
            is in a folder in it until it is finished.
        progress, max_seconds, engine: see `train`. A copy that was stopped is continued.
        replace: replace the agent in the folder even if it has more steps than the copy will have,
            or a critic from policy evaluation.

    Returns:
        The agent; None if the copy was stopped before its end, which leaves the old agent.

    Raises:
        ValueError: if there is no such run, its files are damaged, its rate is below `last_rate`,
            the agent in the folder has more steps or a critic from policy evaluation, or the copy
            that was stopped is of another step of the run or has other settings.
    """
    require_integer("steps", steps, 1, MOST_STEPS)
    require_number("last_rate", last_rate, 0)
    require_engine("engine", engine)
    _require_budget(None, max_seconds, progress)
    require_flag("replace", replace)
    folder = chosen_folder(folder, name)
    copy = folder / "annealed"
    engine = _engine(folder, engine)
    config = _begin_annealing(folder, copy, steps, last_rate, replace)
    trainer = Trainer(config, copy, engine)
    with trainer.alone():
        trainer.start()
        _run(trainer, progress, None, max_seconds)
        if trainer.steps < config.iterations * config.batch:
            return None
        agent = trainer.save_agent(folder)
        # By renaming it first: a copy of which a killed call has removed half would be no run.
        finished = folder / f".annealed.{secrets.token_hex(4)}.tmp"
        os.replace(copy, finished)
    for leftover in folder.glob(".annealed.*.tmp"):
        shutil.rmtree(leftover, ignore_errors=True)
    return agent


def _begin_annealing(
    folder: Path, copy: Path, steps: int, last_rate: float, replace: bool
) -> TrainConfig:
    """Copy a run's files, with a new phase: `steps` more, and a rate that falls to `last_rate`.

    A copy that is there already stays. Returns the configuration of the new phase.
    """
    missing = [file for file in STATE_FILES if not (folder / file).exists()]
    if missing:
        raise ValueError(f"there is no run to anneal in {folder.name}: {missing[0]} is missing")
    # The state is read first: curve rows that are newer than it do no harm.
    state = (folder / STATE_FILES[0]).read_bytes()
    done = _iterations(folder)
    phases = _phases(folder / "training.json")
    # Checked, but kept as it was written: the copy continues from it.
    _from_plain(
        TrainConfig, phases[-1].get("config"), f"the configuration in {folder}/training.json"
    )
    config = dict(phases[-1]["config"])
    batch = config["num_envs"] * config["rollout_length"]
    first, last = config["learning_rate"]
    total = config["total_steps"] // batch
    rate = first + (last - first) * min(done / max(total, 1), 1.0)
    if last_rate > rate:
        raise ValueError(
            f"last_rate is {last_rate:g}, above the present rate of the run, {rate:g}: give a "
            "lower one"
        )
    more = max(1, round(steps / batch))
    # Linear over the whole run, through the present rate now and the last one at the end.
    slope = (last_rate - rate) / more
    config |= {
        "total_steps": (done + more) * batch,
        "learning_rate": [rate - slope * done, last_rate],
    }
    if not replace:
        _keep_agent(folder, config["total_steps"])
        _keep_critic(folder)
    phases.append({"from_step": done * batch, "config": config})
    if (copy / "training.safetensors").exists():
        delete = "delete that folder to begin anew"
        if read_json(copy / "training.json", delete) != phases:
            raise ValueError(
                f"{copy} is from an annealing that was stopped, of another step of the run or with "
                "other steps or rate; delete that folder to begin anew"
            )
    else:
        atomic_write(copy / "training.json", json.dumps(phases, indent=1) + "\n")
        atomic_write(copy / "training.csv", (folder / "training.csv").read_bytes())
        # The state comes last: a copy without it is made again.
        atomic_write(copy / "training.safetensors", state)
    return _from_plain(TrainConfig, config)


def train_critic(
    agent: Agent,
    critic: CriticConfig,
    steps: int | None = None,
    folder=None,
    progress: bool = True,
    max_seconds: float | None = None,
    engine: str = "auto",
    task_of: str = "evaluation",
    **changes,
) -> Agent:
    """Policy evaluation: train a new critic for a frozen policy, at all distances from f = 0.

    The task is the one that designs are evaluated on (`TaskConfig.evaluation`): every action is
    late by one step, and the commands of small bodies are as fast as those of large ones. With
    the task of the policy's training (`task_of="training"`, the older way), a critic takes slow
    commands for a merit of small bodies. Notebook 04 compares the two: at λ = 100 the newer way
    finds better bodies, at λ = 20 for the Go2 only.

    The agent's policy acts on designs f ~ U([-r, r]^d) with r ~ U(0, 1), with its mean actions as
    in evaluation: with exploration noise, the critic learns which bodies bear that noise, too. It
    learns TD(lambda) returns, using each step once, so that more time goes into new bodies. An
    episode lasts 200 control steps at most, since what a critic has to learn here is the design:
    it sees more of them than with whole episodes, and the value of what follows is bootstrapped.
    The new state bank comes from such designs and episodes too, at all distances from f = 0
    instead of over the full design space.

    Args:
        agent: its policy is kept, its critic and state bank are replaced.
        critic: sizes of the new critic.
        steps: environment steps; 12 % of those that training takes at the agent's scale if not
            given, 6 million at `reduced`.
        folder: where the new agent is saved; data/checkpoints/<agent> by default, which replaces
            the old critic there. The phase's own state and curve are in a folder in it, which
            stays: a later call with more `steps` goes on from there.
        progress, max_seconds, engine: see `train`. A phase that was stopped is continued.
        task_of: "evaluation", or "training" for the task that the policy was trained on.
        changes: replace fields of the TrainConfig; by default gae_lambda is 0.95, epochs is 1,
            mean_actions is True, rollouts have at least 32 steps, and the inputs are standardized
            at all scales.

    Returns:
        The agent with the new critic and a new state bank. Its metadata are those of the policy's
        training, with those of this phase under "policy_evaluation". If the phase was stopped
        before its end, `agent` itself, and nothing in the folder is replaced.
    """
    require_agent(agent)
    require_kind("critic", critic, CriticConfig, "shapebody.CriticConfig.sharp()")
    require_choice("task_of", task_of, ("evaluation", "training"))
    if steps is not None:
        require_integer("steps", steps, 1, MOST_STEPS)
    require_engine("engine", engine)
    _require_budget(None, max_seconds, progress)
    if folder is None:
        folder = chosen_folder(None, agent.name)
        # The agent may come from elsewhere, and its name be that of another one here.
        if _metadata(folder) and load_agent(folder).policy_hash != agent.policy_hash:
            raise ValueError(
                f"the agent in {folder} has another policy than agent {agent.name!r}, whose new "
                "critic would be saved there; give its own folder (folder=...)"
            )
    folder = require_path("folder", folder)
    missing = [name for name in ("config", "scale") if name not in agent.metadata]
    if missing:
        raise ValueError(
            f"the metadata of agent {agent.name!r} lack {missing[0]!r}, which says how its policy "
            "was trained; restore its agent.json, or train it anew"
        )
    what = f"metadata of agent {agent.name!r}: config"
    trained = _from_plain(TrainConfig, agent.metadata["config"], what)
    base = TrainConfig.at_scale(agent.metadata["scale"], trained.robots[0], name=agent.name)
    length = max(base.rollout_length, 32)
    config = replace(
        base,
        **{
            # Robots by the names or files they were trained from.
            "robots": trained.robots,
            "seed": trained.seed,
            "policy": agent.policy_config,
            "critic": critic,
            "standardize": True,
            "learn_policy": False,
            "mean_actions": True,
            "epochs": 1,
            "discount": trained.discount,
            "gae_lambda": 0.95,
            "value_lambda": None,
            # Returns with that λ look further ahead than short rollouts reach.
            "num_envs": base.batch // length,
            "rollout_length": length,
            "total_steps": base.total_steps * 12 // 100 if steps is None else steps,
            "task": replace(
                TaskConfig.evaluation() if task_of == "evaluation" else trained.task,
                horizon=200,
                design_radius=(0.0, 1.0),
            ),
            **changes,
        },
    )
    # The state belongs to this policy: another one starts anew.
    trainer = Trainer(config, folder / f"critic_{agent.policy_hash[:8]}", engine, agent.policy)
    phases = agent.metadata.get("phases") or [{}]
    _require_same_robots(phases[0].get("robots", {}), trainer.env.robots, f"agent {agent.name!r}")
    with trainer.alone():
        trainer.start()
        _run(trainer, progress, None, max_seconds)
        if trainer.steps < config.iterations * config.batch:
            return agent
        sharper = trainer.agent(trainer.state_bank())
        phase = {name: sharper.metadata[name] for name in ("config", "steps", "seconds")}
        sharper = replace(sharper, metadata={**agent.metadata, "policy_evaluation": phase})
        save_agent(sharper, folder)
    return sharper


def _run(trainer: Trainer, progress, max_steps, max_seconds) -> None:
    """Run until the end, a budget or an interrupt; raise an interrupt before anything was saved."""
    try:
        trainer.run(max_steps, max_seconds, progress)
    except KeyboardInterrupt:
        saved = (trainer.folder / "training.safetensors").exists()
        if progress and saved:
            print("\ninterrupted: saved, the same call continues", flush=True)
        elif progress:
            print("\ninterrupted before the first iteration: nothing was saved", flush=True)
        if not saved:
            raise
        # The learner may be an iteration ahead of the state on disk, where the next call begins.
        trainer.start()


CHANGEABLE = (
    "total_steps",
    "epochs",
    "minibatch_size",
    "learning_rate",
    "entropy_coefficient",
    "value_lambda",
    "cut_at_commands",
    "state_bank",
)
"""Fields that may change when a run is continued; each change is recorded."""

CHANGEABLE_INSIDE = {"policy": ("std_limits",), "task": ("horizon", "curriculum_length")}
"""What may change inside other fields: the limits of the exploration noise, and the lengths of
episodes (those that are under way keep theirs)."""


def as_continued(config: TrainConfig, folder=None) -> TrainConfig:
    """The configuration of the run in the folder of `config`, if there is one to continue.

    `config` itself if there is none, or one of other robots or of another scale. So a run goes on
    with the settings that it was begun with, whatever the defaults are now. To change one that may
    change (`CHANGEABLE`, `CHANGEABLE_INSIDE`), replace it in the result.
    """
    _require_run(config)
    folder = chosen_folder(folder, config.name)
    if not (folder / "training.safetensors").exists():
        return config
    try:
        last = _from_plain(TrainConfig, _phases(folder / "training.json")[-1].get("config"))
    except (OSError, ValueError):
        return config  # nothing to continue, or a damaged file, which `Trainer.start` reports

    def identity(config):
        return config.name, [_robot_name(robot) for robot in config.robots], config.scale

    # Their files may have moved; `Trainer.start` compares them with those of the run.
    return replace(last, robots=config.robots) if identity(last) == identity(config) else config


ANEW = "restore it, or delete training.safetensors beside it to begin anew"
"""What to do about a damaged file of a run."""


def _iterations(folder: Path) -> int:
    """Finished iterations of the run in a folder."""
    path = folder / "training.safetensors"
    fix = "restore it, or delete it to begin anew"
    number = read_number(path, "learner/iteration", fix)
    if number < 0:
        raise ValueError(f"{path} is damaged: it has {number} iterations; {fix}")
    return number


def _phases(path: Path) -> list[dict]:
    """The phases of a run, as its training.json holds them (`_continued`).

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if it is damaged.
    """
    try:
        phases = read_json(path, ANEW)
        if not isinstance(phases, list) or not phases:
            raise ValueError("it holds no phases")
        kinds = {"config": dict, "from_step": int, "robots": dict, "engine": str}
        for phase in phases:
            if not isinstance(phase, dict):
                raise ValueError("a phase is no object")
            for name, kind in kinds.items():
                if not isinstance(phase.get(name, kind()), kind):
                    raise ValueError(f"{name} of a phase is of another kind than {kind.__name__}")
            if phase.get("engine", "native") not in ("native", "mjx"):
                raise ValueError(f"the engine is {shown(phase['engine'])}")
    except ValueError as error:
        raise ValueError(
            f"{path.name} is missing or damaged ({error}); it says how the run in {path.parent} "
            f"was configured: {ANEW}"
        ) from error
    return phases


def _engine(folder: Path, engine: str) -> str:
    """The engine for a run in a folder: that of the run there, or `engine` if there is none.

    Raises:
        ValueError: if the run there has another engine than `engine`, which is not "auto".
    """
    if not (folder / "training.safetensors").exists():
        return engine
    try:
        # A run that does not say so is older than the record and native.
        own = _phases(folder / "training.json")[0].get("engine", "native")
    except (OSError, ValueError):
        return engine  # a damaged file, which `Trainer.start` reports
    if engine not in ("auto", own):
        raise ValueError(
            f"engine is {engine!r}, but the run in {folder.name} was begun with {own!r}, whose "
            f"physics state no other engine can read: continue it with 'auto' or {own!r}, or begin "
            "a run under another name"
        )
    return own


def _continued(path: Path, config: TrainConfig, steps: int, robots=()) -> list[dict]:
    """The phases of a run that goes on with `config`: a list of {"from_step", "config"}, the first
    with hashes of the robots' files and the name of the engine.

    Raises:
        ValueError: if more than what is changeable, or a robot's file, differs from the run in
            `path`.
    """
    phases = _phases(path)
    try:
        # Settings that are newer than the run are at their defaults in it.
        last = _from_plain(TrainConfig, phases[-1].get("config"), "config")
    except ValueError as error:
        raise ValueError(
            f"{path.name} of the run in {path.parent} is damaged, or has settings that this "
            f"version of shapebody does not know ({error}); continue it with the version that "
            f"began it, or {ANEW}"
        ) from error
    before = _plain(replace(last, robots=tuple(_located(robot) for robot in last.robots)))
    known = phases[0].get("robots", {})
    if [r.name for r in robots] == [_robot_name(r) for r in last.robots] and all(
        r.name in known for r in robots
    ):
        # Files that have only moved are the same robots: their hashes are compared below.
        before["robots"] = list(config.robots)
    now = _plain(config)
    different = [name for name in now if before.get(name) != now[name]]
    changeable = list(CHANGEABLE)
    for field_name, inside in CHANGEABLE_INSIDE.items():
        new = {name: now[field_name][name] for name in inside}
        if before[field_name] | new == now[field_name]:
            changeable.append(field_name)
    other = [name for name in different if name not in changeable]
    if other:
        text = "; ".join(_difference(name, before.get(name), now[name]) for name in other)
        raise ValueError(
            f"the run in {path.parent.name} has another configuration ({text}); continue it with "
            "the old one, which shapebody.ppo.as_continued(config) returns, choose another name, "
            "or delete its training.safetensors to begin anew"
        )
    _require_same_robots(known, robots, f"the run in {path.parent.name}")
    return phases + [{"from_step": steps, "config": now}] if different else phases


def _require_same_robots(known: dict, robots, what: str) -> None:
    """ValueError if the file of a robot is not the one whose hash was recorded."""
    changed = [r.name for r in robots if known.get(r.name, r.hash) != r.hash]
    if changed:
        raise ValueError(
            f"the file of robot {', '.join(changed)} has changed since {what} began, or is another "
            "one of that name; put the old file back, or train under another name"
        )


def _difference(name: str, old, new) -> str:
    if isinstance(old, dict) and isinstance(new, dict):
        inside = [key for key in new if old.get(key) != new[key]]
        return "; ".join(_difference(f"{name}.{key}", old.get(key), new[key]) for key in inside)
    return f"{name} was {old!r}, is {new!r}"


def _rows(path: Path) -> tuple[list[dict[str, str]], bool]:
    """The rows of a learning curve as text, and whether others in the file are damaged.

    A last row that a killed run left unfinished is left out and is no damage. No file, no rows.
    """
    if not path.exists():
        return [], False
    try:
        text = read_text(path, ANEW)
    except ValueError:
        return [], True
    # The end of a line is written last; without it, even the last number may be cut off.
    header, *lines = [_cells(line) for line in text.split("\n")[:-1]] or [[]]
    # A file of another version may have other columns; what is no header at all is damaged.
    known = "steps" in header and set(header) <= set(CURVE)
    names = header if known else CURVE
    rows = [dict(zip(names, x, strict=True)) if _is_row(x, names) else None for x in lines]
    whole = [row for row in rows if row is not None]
    unfinished = bool(rows) and rows[-1] is None
    return whole, bool(lines) and not known or len(rows) - len(whole) > unfinished


def _cells(line: str) -> list[str]:
    """Cells of a line; numbers have no quotes."""
    return line.removesuffix("\r").split(",")


def _is_row(cells: list[str], names) -> bool:
    """Whether these are the cells of a row: a number of steps, and numbers or nothing."""
    if len(cells) != len(names):
        return False
    steps = cells[names.index("steps")]
    try:
        [float(cell) for cell in cells if cell]
    except ValueError:
        return False
    return steps.isascii() and steps.isdigit() and len(steps) < 20


class _Curve:
    """Averages over iterations, appended to a CSV file. Rows after the resumed step go.

    A damaged file is kept beside it, and its undamaged rows are used.
    """

    def __init__(self, path: Path, steps: int):
        self.path = path
        rows, damaged = _rows(path)
        if damaged:
            kept = path.with_suffix(".damaged.csv")
            os.replace(path, kept)
            print(f"{path} was damaged: kept as {kept.name}, {len(rows)} rows could be read")
        rows = [row for row in rows if int(row["steps"]) <= steps]
        # Of rows that are there twice, the first.
        rows = list({int(row["steps"]): row for row in reversed(rows)}.values())[::-1]
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, CURVE)
        writer.writeheader()
        writer.writerows(rows)
        atomic_write(path, text.getvalue())
        self.latest = {}
        self.episodes = (0, 0.0, 0.0, 0.0)
        self._clear()

    def _clear(self):
        self.sums, self.count, self.ended = {}, 0, []

    def add(self, trajectory: Trajectory, metrics, seconds, batch):
        done = np.asarray(trajectory.terminated) | np.asarray(trajectory.truncated)
        columns = (
            trajectory.episode_return,
            trajectory.episode_length,
            trajectory.episode_error,
        )
        self.ended.append(np.stack([np.asarray(x)[done] for x in columns], -1))
        values = {
            **metrics,
            "seconds": seconds,
            "batch": batch,
            "coefficient": float(np.mean(trajectory.coefficient)),
            "reward": float(np.mean(trajectory.reward)),
            "non_finite": float(np.sum(~np.asarray(trajectory.finite))),
        }
        self.count += 1
        for name, value in values.items():
            self.sums[name] = self.sums.get(name, 0.0) + value
        # Where no episode has ended since the last row, the last ones that did are shown.
        self.latest = self.latest | self._row()

    def _row(self):
        row = {name: self.sums[name] / self.count for name in CURVE if name in self.sums}
        ended = np.concatenate(self.ended)
        if len(ended):
            row |= dict(
                zip(("return", "length", "tracking_error"), ended.mean(0).tolist(), strict=True)
            )
        row["non_finite"] = self.sums["non_finite"]
        row["steps_per_second"] = self.sums["batch"] / max(self.sums["seconds"], 1e-9)
        return row

    def write(self, steps, seconds):
        row = {"steps": steps, "seconds": round(seconds, 1)}
        row |= {
            name: f"{value:.5g}"
            for name, value in self._row().items()
            if name in CURVE and name != "seconds"
        }
        with names_path(self.path), self.path.open("a", newline="") as file:
            csv.DictWriter(file, CURVE).writerow(row)
        self._clear()


class _Report:
    """One progress line every few seconds, rewritten in place on a terminal.

    last: steps at which the call ends; until: time (`time.monotonic`) at which it does, if earlier.
    """

    def __init__(self, last: int, until: float, active: bool, interval: float = 5.0):
        self.last, self.until, self.active = last, until, active
        self.interactive = sys.stdout.isatty() or "ipykernel" in sys.modules
        self.interval = interval if self.interactive else 12 * interval
        self.next = 0.0

    def show(self, steps: int, curve: _Curve):
        now = time.monotonic()
        if not self.active or now < self.next:
            return
        self.next = now + self.interval
        row = curve.latest
        left = (self.last - steps) / max(row["steps_per_second"], 1e-9)
        left = max(min(left, self.until - now), 0.0)
        ended = "no episode has ended yet"
        if "return" in row:
            ended = f"return {row['return']:6.2f}  xy error {row['tracking_error']:.3f} m/s"
        line = (
            f"{steps:>12,} steps  {ended}  c {row['coefficient']:.2f}  "
            f"{row['steps_per_second']:,.0f} steps/s  {_duration(left)} left"
        )
        print(
            ("\r" if self.interactive else "") + line,
            flush=True,
            end="" if self.interactive else "\n",
        )

    def end(self):
        if self.active and self.interactive:
            print(flush=True)


def _duration(seconds: float) -> str:
    minutes = int(seconds // 60)
    return (
        f"{minutes // 60}h{minutes % 60:02d}"
        if minutes >= 60
        else f"{minutes}m{int(seconds) % 60:02d}"
    )
