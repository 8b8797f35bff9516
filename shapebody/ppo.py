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

import csv
import io
import json
import math
import shutil
import sys
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, is_dataclass, replace
from pathlib import Path
from typing import Any, get_type_hints

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
)
from shapebody.files import alone_in, read_safetensors
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
from shapebody.robots import load_robot
from shapebody.runtime import keep_memory

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
    agent itself and its `curve.csv` change only in `save_agent`.

    Args:
        config: the run.
        folder: the agent's folder; data/checkpoints/<name> if not given.
        engine: "native", "mjx" or "auto": that of the run in the folder or, if there is none, the
            one that `Locomotion` chooses.
        policy: variables of a frozen policy, for the policy-evaluation phase.

    Raises:
        ValueError: if the run in the folder has another engine.
    """

    def __init__(self, config: TrainConfig, folder=None, engine: str = "auto", policy=None):
        _require_run(config, engine)
        if policy is not None and not (isinstance(policy, Mapping) and "params" in policy):
            raise refuse("policy", policy, "variables of a Policy, such as agent.policy")
        keep_memory()
        self.config = config
        self.folder = chosen_folder(folder, config.name)
        robots = [load_robot(name) for name in config.robots]
        task = config.task
        if not config.learn_policy:
            task = replace(task, fixed_coefficient=True)
        engine = _engine(self.folder, engine)
        self.env = Locomotion(robots, config.num_envs, engine=engine, config=task)
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

    def save(self) -> None:
        """Write the training state."""
        path = self.folder / "training.json"
        text = json.dumps(self.phases, indent=1) + "\n"
        if not path.exists() or path.read_text() != text:
            atomic_write(path, text)
        save_arrays(self.folder / "training.safetensors", self._everything())

    def start(self) -> bool:
        """Resume from the folder, or start afresh; True if resumed.

        Raises:
            ValueError: if the run in the folder is of another configuration, or its files are
                damaged.
        """
        path = self.folder / "training.safetensors"
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
        curve = self.folder / "training.csv"
        save_agent(agent, folder, _rows(curve) if curve.exists() else None)
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
            ValueError: if another process trains in the same folder.
        """
        _require_budget(max_steps, max_seconds, progress)
        if curve_interval is not None:
            require_integer("curve_interval", curve_interval, 1)
        config = self.config
        number, last = int(self.learner.iteration), self.last_iteration(max_steps)
        if number >= last:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        if not self.in_step:
            if self.env.engine == "native":
                self.env.restore(self.state, self.saved_physics)
            else:
                self.env.physics_state = self.saved_physics
        self.in_step = False
        # On an accelerator there is nothing to overlap: the device does one thing at a time.
        overlap = self.env.engine == "native"
        with alone_in(self.folder), ThreadPoolExecutor(1) as actor:
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

        Returns (Observation [M, ...] of numpy arrays, robot index int32[M]).
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
            t, n = good[rng.choice(len(good), per, replace=per > len(good))].T
            parts.append(
                jax.tree.map(lambda x, t=t, n=n: np.asarray(x)[t, n], trajectory.observation)
            )
            robots.append(owner[n])
        bank = jax.tree.map(lambda *x: np.concatenate(x)[:count].astype(np.float32), *parts)
        return bank, np.concatenate(robots)[:count].astype(np.int32)


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
    trainer.start()
    begun = trainer.steps
    if not (state_only or replace) and begun < trainer.last_iteration(max_steps) * config.batch:
        others = ", state_only=True (--state-only) to leave it, or choose another name or folder"
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
    path = folder / "agent.json"
    if not path.exists():
        return None
    try:
        metadata = json.loads(path.read_text())["metadata"]
        return metadata | {"steps": int(metadata["steps"])}
    except (ValueError, LookupError, TypeError):
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
    trainer.start()
    _run(trainer, progress, None, max_seconds)
    if trainer.steps < config.iterations * config.batch:
        return None
    agent = trainer.save_agent(folder)
    shutil.rmtree(copy)
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
    phases = json.loads((folder / "training.json").read_text())
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
        if json.loads((copy / "training.json").read_text()) != phases:
            raise ValueError(
                f"{copy} is from an annealing that was stopped, of another step of the run or with "
                "other steps or rate; delete that folder to begin anew"
            )
    else:
        atomic_write(copy / "training.json", json.dumps(phases, indent=1) + "\n")
        atomic_write(copy / "training.csv", (folder / "training.csv").read_text())
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
    **changes,
) -> Agent:
    """Policy evaluation: train a new critic for a frozen policy, at all distances from f = 0.

    The task is the one that designs are evaluated on (`TaskConfig.evaluation`): every action is
    late by one step, and the commands of small bodies are as fast as those of large ones. With
    the task of the policy's training, a critic takes slow commands for a merit of small bodies.

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
    if steps is not None:
        require_integer("steps", steps, 1, MOST_STEPS)
    require_engine("engine", engine)
    _require_budget(None, max_seconds, progress)
    folder = chosen_folder(folder, agent.name)
    missing = [name for name in ("config", "scale") if name not in agent.metadata]
    if missing:
        raise ValueError(
            f"the metadata of agent {agent.name!r} lack {missing[0]!r}, which says how its policy "
            "was trained; restore its agent.json, or train it anew"
        )
    trained = _from_plain(TrainConfig, agent.metadata["config"])
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
            "task": TaskConfig.evaluation(horizon=200, design_radius=(0.0, 1.0)),
            **changes,
        },
    )
    # The state belongs to this policy: another one starts anew.
    trainer = Trainer(config, folder / f"critic_{agent.policy_hash[:8]}", engine, agent.policy)
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


def _plain(config: TrainConfig) -> dict:
    """A configuration as it reads back from JSON: tuples are lists, inf is the text "Infinity"."""
    return json.loads(json.dumps(asdict(config)), parse_constant=str)


def _from_plain(kind, values: dict):
    """The inverse of `_plain`: a configuration from what was read from JSON."""

    def value(hint, given):
        if is_dataclass(hint):
            return _from_plain(hint, given)
        if hint is float and given == "Infinity":
            return math.inf
        return tuple(value(None, x) for x in given) if isinstance(given, list) else given

    hints = get_type_hints(kind)
    return kind(**{name: value(hints.get(name), given) for name, given in values.items()})


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
        plain = json.loads((folder / "training.json").read_text())[-1]["config"]
        last = _from_plain(TrainConfig, plain)
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return config  # nothing to continue, or a damaged file, which `Trainer.start` reports
    same = (last.name, last.robots, last.scale) == (config.name, config.robots, config.scale)
    return last if same else config


def _iterations(folder: Path) -> int:
    """Finished iterations of the run in a folder."""
    state = read_safetensors(folder / "training.safetensors", "restore it, or train anew")
    return int(state["learner/iteration"])


def _engine(folder: Path, engine: str) -> str:
    """The engine for a run in a folder: that of the run there, or `engine` if there is none.

    Raises:
        ValueError: if the run there has another engine than `engine`, which is not "auto".
    """
    if not (folder / "training.safetensors").exists():
        return engine
    try:
        # A run that does not say so is older than the record and native.
        own = json.loads((folder / "training.json").read_text())[0].get("engine", "native")
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
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
    try:
        phases = json.loads(path.read_text())
        before = dict(phases[-1]["config"])
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise ValueError(
            f"{path.name} is missing or damaged ({error}); it says how the run in "
            f"{path.parent.name} was configured: restore it, or start anew in another folder"
        ) from error
    try:
        # Settings that are newer than the run are at their defaults in it.
        before = _plain(_from_plain(TrainConfig, before))
    except TypeError as error:
        raise ValueError(
            f"{path.name} of the run in {path.parent.name} has settings that this version of "
            f"shapebody does not know ({error}); continue it with the version that began it, or "
            "start anew in another folder"
        ) from error
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
    known = phases[0].get("robots", {})
    changed = [r.name for r in robots if known.get(r.name, r.hash) != r.hash]
    if changed:
        raise ValueError(
            f"the file of robot {', '.join(changed)} has changed since the run in "
            f"{path.parent.name} began; put the old file back, or train under another name"
        )
    return phases + [{"from_step": steps, "config": now}] if different else phases


def _difference(name: str, old, new) -> str:
    if isinstance(old, dict) and isinstance(new, dict):
        inside = [key for key in new if old.get(key) != new[key]]
        return "; ".join(_difference(f"{name}.{key}", old.get(key), new[key]) for key in inside)
    return f"{name} was {old!r}, is {new!r}"


def _rows(path: Path) -> list[dict[str, str]]:
    """The rows of a learning curve as text, without those that a killed run left unfinished."""
    # The end of a line is written last; without it, even the last number may be cut off.
    lines = [line for line in path.read_text().splitlines(keepends=True) if line.endswith("\n")]

    def whole(row):
        # A missing cell is None, and cells that are too many are under the name None.
        return None not in row and None not in row.values() and row["steps"].isdigit()

    return [row for row in csv.DictReader(lines) if whole(row)]


class _Curve:
    """Averages over iterations, appended to a CSV file. Rows after the resumed step go."""

    def __init__(self, path: Path, steps: int):
        self.path = path
        rows = _rows(path) if path.exists() else []
        rows = [row for row in rows if int(row["steps"]) <= steps]
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
        with self.path.open("a", newline="") as file:
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
