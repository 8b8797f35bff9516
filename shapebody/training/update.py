"""One iteration of the learner: from a rollout to a better policy and critic.

Every function takes the configuration as a static argument, holds no state, and can be called by
any trainer. `ppo_update` is all of them in one compiled program.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax

from shapebody.arguments import refuse, require_key, require_kind
from shapebody.design.mirror import mirrored
from shapebody.networks.critic import Critic
from shapebody.networks.policy import Policy, log_prob
from shapebody.task.observations import mirrored_observation
from shapebody.task.trajectory import Trajectory
from shapebody.training import losses
from shapebody.training.chunks import mapped, number_of_chunks, summed
from shapebody.training.config import TrainConfig


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Learner:
    """Everything the learner changes."""

    policy: Any  # variables of Policy.apply
    critic: Any  # variables of Critic.apply
    policy_optimizer: Any
    critic_optimizer: Any
    iteration: jax.Array  # [] int32, finished iterations
    average: Any = None  # running average of the policy's parameters, if the run has one


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Batch:
    """A rollout with what its losses need, by environment and step: [N, T, ...]."""

    observation: Any
    descriptions: Any  # [N, 2, ...] the designs at the rollout's start and end
    slot: jax.Array  # which of the two a step is of, 0 or 1
    valid: jax.Array  # 0 where it is of neither: its episode began and ended in the rollout
    action: jax.Array
    target: jax.Array  # TD(λ) return
    advantage: jax.Array  # normalized
    proximal: jax.Array | None = None  # log density under π_old; None if only the critic learns
    importance: jax.Array | None = None  # min(π_old / μ, 2); None likewise
    flipped: jax.Array | None = None  # [N] bool, whose mirror images the critic learns, if any


def init_learner(config: TrainConfig, policy, critic) -> Learner:
    """A learner before its first iteration.

    Args:
        config: the run.
        policy, critic: variables of its networks, from `networks.inputs.initialize`.
    """
    require_kind("config", config, TrainConfig, "such as TrainConfig.reduced(...)")
    require_variables("policy", policy)
    require_variables("critic", critic)
    return Learner(
        policy=policy,
        critic=critic,
        policy_optimizer=optimizer(config).init(policy["params"]),
        critic_optimizer=optimizer(config).init(critic["params"]),
        iteration=jnp.zeros((), jnp.int32),
        average=None if config.average_half_life is None else policy["params"],
    )


def learned_policy(learner: Learner):
    """Variables of the policy that a run has come to: of its running average, if it has one."""
    if learner.average is None:
        return learner.policy
    return {**learner.policy, "params": learner.average}


def require_variables(name: str, value):
    """The value; ValueError if it is not the variables of a network."""
    if not (isinstance(value, Mapping) and "params" in value):
        raise refuse(name, value, "variables of a network, such as agent.policy or agent.critic")
    return value


def ppo_update(config: TrainConfig, learner: Learner, trajectory: Trajectory, key):
    """One iteration: several epochs of gradient steps on a rollout.

    The first call with a configuration compiles it, which takes seconds to minutes.

    Args:
        config: the run.
        learner: from `init_learner` or the last iteration.
        trajectory: `config.rollout_length` steps of `config.num_envs` environments, whose `extra`
            is the log density of each action under the policy that acted.
        key: PRNG key of the order of the minibatches.

    Returns:
        The new learner and the metrics of the iteration, numbers by name.
    """
    require_kind("config", config, TrainConfig, "such as TrainConfig.reduced(...)")
    require_kind("learner", learner, Learner, "from init_learner(...)")
    require_kind("trajectory", trajectory, Trajectory, "what Locomotion.rollout returned")
    require_key("key", key)
    return _ppo_update(config, learner, trajectory, key)


@partial(jax.jit, static_argnums=0)
def _ppo_update(config, learner, trajectory, key):
    batch, metrics = prepare(config, learner, trajectory)
    if config.mirrored_critic:
        flipped = jax.random.bernoulli(jax.random.fold_in(key, 1), shape=(config.num_envs,))
        batch = replace(batch, flipped=flipped)
    rate = learning_rate(config, learner.iteration)
    rows = minibatch_rows(config, key)
    learner, of_steps = gradient_steps(config, learner, batch, rows, rate)
    metrics = {**of_steps, "learning_rate": rate, **metrics}
    if config.average_half_life is not None:
        keep = 0.5 ** (config.batch / config.average_half_life)
        average = optax.incremental_update(learner.policy["params"], learner.average, 1 - keep)
        learner = replace(learner, average=average)
    return replace(learner, iteration=learner.iteration + 1), metrics


# ------------------------------------------------------------------ the rollout


def prepare(config: TrainConfig, learner: Learner, trajectory: Trajectory):
    """Targets, advantages and densities of a rollout: (Batch, metrics of the critic)."""

    def by_env(tree):
        return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), tree)

    policy, critic = Policy(config.policy), Critic(config.critic)
    chunks = number_of_chunks(config.num_envs, config.rollout_length)
    observation, descriptions = by_env(trajectory.observation), by_env(trajectory.descriptions)
    slot, valid = by_env(trajectory.slot), by_env(trajectory.valid)
    reward = by_env(trajectory.reward)
    inputs = descriptions, slot, observation
    heads = mapped(lambda x: apply_at_steps(critic, learner.critic, *x), inputs, chunks)
    value = jnp.mean(heads, -1)
    latest = jax.tree.map(lambda x: x[:, 1], descriptions)
    last_value = jnp.mean(critic.apply(learner.critic, latest, trajectory.last_observation), -1)
    terminated, truncated = by_env(trajectory.terminated), by_env(trajectory.truncated)

    def estimate(truncated, gae_lambda):
        return losses.advantages(
            reward, value, last_value, terminated, truncated, config.discount, gae_lambda
        )

    # Targets of the critic; advantages, which may also end where the command changes.
    value_lambda = config.gae_lambda if config.value_lambda is None else config.value_lambda
    target = estimate(truncated, value_lambda) + value
    cut = truncated
    if config.cut_at_commands:
        cut |= losses.command_changes(observation, trajectory.last_observation)
    advantage = estimate(cut, config.gae_lambda)
    batch = Batch(
        observation=observation,
        descriptions=descriptions,
        slot=slot,
        valid=valid,
        action=by_env(trajectory.action),
        target=target,
        advantage=losses.normalized(advantage, valid),
    )
    # Densities under π_old, and importance weights.
    if config.learn_policy:
        old = learned_policy(learner) if config.average_proximal else learner.policy
        mean, std = mapped(lambda x: apply_at_steps(policy, old, *x), inputs, chunks)
        proximal = log_prob(mean, std, batch.action, descriptions.joint_mask[:, :1])
        importance = losses.importance_weight(proximal, by_env(trajectory.extra))
        batch = replace(batch, proximal=proximal, importance=importance)
    # How well the critic predicted its targets.
    _, residual = losses.moments(target - value, valid)
    _, spread = losses.moments(target, valid)
    return batch, {
        "explained_variance": 1 - residual / jnp.maximum(spread, 1e-8),
        "value": losses.moments(value, valid)[0],
    }


def apply_at_steps(network, variables, descriptions, slot, observation):
    """Output of a network at all steps of a rollout, encoding each design once.

    Args:
        network: a `Policy` or `Critic`; variables: its variables.
        descriptions: [N, 2, ...] of the two designs of each environment.
        slot: [N, T] which of the two a step is of, 0 or 1.
        observation: [N, T, ...].
    """
    embedding = network.apply(variables, descriptions, method="embed")

    def spread(x):
        chosen = slot.reshape(slot.shape + (1,) * (x.ndim - 2)) > 0
        return jnp.where(chosen, x[:, 1, None], x[:, 0, None])

    # The masks belong to the robot, not to the design, so either slot will do.
    masks = jax.tree.map(lambda x: x[:, :1], descriptions)
    return network.apply(
        variables, jax.tree.map(spread, embedding), masks, observation, method="act"
    )


def minibatch_rows(config: TrainConfig, key):
    """Environments of every minibatch, int32[epochs x minibatches, environments in each].

    Every epoch has its own order. Environments that fill no minibatch wait for another epoch.
    """
    per = config.minibatch_size // config.rollout_length
    minibatches = config.num_envs // per
    orders = jax.vmap(lambda k: jax.random.permutation(k, config.num_envs))(
        jax.random.split(key, config.epochs)
    )
    return orders[:, : minibatches * per].reshape(config.epochs * minibatches, per)


# ------------------------------------------------------------------ gradient steps


def optimizer(config: TrainConfig):
    """Adam on gradients of at most `max_gradient_norm`, without the learning rate."""
    return optax.chain(
        optax.clip_by_global_norm(config.max_gradient_norm), optax.scale_by_adam(eps=1e-5)
    )


def learning_rate(config: TrainConfig, iteration):
    """The rate of an iteration: linear from the first to the last of `config.learning_rate`."""
    first, last = config.learning_rate
    return first + (last - first) * jnp.minimum(iteration / config.iterations, 1.0)


def gradient_steps(config: TrainConfig, learner: Learner, batch: Batch, rows, rate):
    """A gradient step on every minibatch: (Learner, means of the steps' metrics).

    Once the KL divergence exceeds `config.kl_threshold`, the rest of the iteration is skipped.
    """
    names = ["value_loss", "updates"] + ["kl", "clipped", "std"] * config.learn_policy
    names += ["mirror"] * (config.learn_policy and config.mirror_coefficient > 0)

    def one(carry, rows):
        learner, stopped = carry
        part = jax.tree.map(lambda x: x[rows], batch)
        learner, stopped, metrics = jax.lax.cond(
            stopped,
            lambda learner: (learner, stopped, {name: jnp.zeros(()) for name in names}),
            lambda learner: gradient_step(config, learner, part, rate, stopped),
            learner,
        )
        return (learner, stopped), metrics

    (learner, _), metrics = jax.lax.scan(one, (learner, jnp.asarray(False)), rows)
    updates = jnp.maximum(jnp.sum(metrics["updates"]), 1.0)
    metrics = {name: jnp.sum(x) / updates for name, x in metrics.items()}
    return learner, metrics | {"updates": updates}


def gradient_step(config: TrainConfig, learner: Learner, batch: Batch, rate, stopped):
    """One step of critic and policy on a minibatch: (Learner, whether to stop, metrics)."""
    # The critic, towards its targets.
    chunks = number_of_chunks(*batch.valid.shape)
    both = batch, losses.step_weights(batch.valid)
    loss, gradient = summed(
        lambda x: jax.value_and_grad(partial(critic_loss, config))(
            learner.critic["params"], constants(learner.critic), *x
        ),
        both,
        chunks,
    )
    critic, state = descend(config, learner.critic, learner.critic_optimizer, gradient, rate)
    metrics = {"value_loss": loss, "updates": jnp.ones(())}
    # The policy, unless it is frozen (policy evaluation).
    policy, policy_state = learner.policy, learner.policy_optimizer
    if config.learn_policy:
        (_, more), gradient = summed(
            lambda x: jax.value_and_grad(partial(policy_loss, config), has_aux=True)(
                policy["params"], constants(policy), *x
            ),
            both,
            chunks,
        )
        policy, policy_state = descend(config, policy, policy_state, gradient, rate)
        metrics |= more
        # Not "kl > threshold", which would let a NaN pass.
        stopped = ~(metrics["kl"] <= config.kl_threshold)
    learner = replace(
        learner,
        policy=policy,
        critic=critic,
        policy_optimizer=policy_state,
        critic_optimizer=state,
    )
    return learner, stopped, metrics


def policy_loss(config: TrainConfig, params, constants, batch: Batch, weight):
    """(surrogate loss minus entropy bonus, metrics) of the policy's parameters on steps whose
    weights [N, T] are `weight`; sums, so that those of the chunks of a minibatch can be added."""
    variables = {"params": params, **constants}
    mean, std = apply_at_steps(
        Policy(config.policy), variables, batch.descriptions, batch.slot, batch.observation
    )
    mask = batch.descriptions.joint_mask[:, :1]
    density = log_prob(mean, std, batch.action, mask)
    ratio, log_ratio = losses.policy_ratio(density, batch.proximal, batch.valid)
    loss = losses.surrogate_loss(
        ratio, batch.advantage, batch.importance, weight, config.clip_range
    )
    loss = loss - config.entropy_coefficient * losses.entropy_bonus(std, mask, weight)
    metrics = {}
    if config.mirror_coefficient > 0:
        # Both sides are moved: neither of two different actions is known to be the better one.
        image, sign = mirrored(batch.descriptions), batch.descriptions.mirrored.sign[:, :1]
        seen = mirrored_observation(batch.observation, sign)
        there, _ = apply_at_steps(Policy(config.policy), variables, image, batch.slot, seen)
        defect = jnp.sum(jnp.sum((sign * there - mean) ** 2, -1) * weight)
        loss = loss + config.mirror_coefficient * defect
        metrics["mirror"] = defect
    return loss, metrics | {
        "kl": losses.approximate_kl(ratio, log_ratio, weight),
        "clipped": losses.clipped_share(ratio, weight, config.clip_range),
        "std": jnp.sum(jnp.sum(std * mask, -1) / jnp.sum(mask, -1) * weight),
    }


def critic_loss(config: TrainConfig, params, constants, batch: Batch, weight):
    """The value loss of the critic's parameters on steps whose weights [N, T] are `weight`."""
    variables = {"params": params, **constants}
    seen = batch.descriptions, batch.observation
    if batch.flipped is not None:
        image = mirrored(batch.descriptions)
        image = image, mirrored_observation(batch.observation, image.mirrored.sign[:, :1])
        seen = jax.tree.map(partial(_where, batch.flipped), image, seen)
    descriptions, observation = seen
    values = apply_at_steps(Critic(config.critic), variables, descriptions, batch.slot, observation)
    return losses.value_loss(values, batch.target, weight)


def _where(chosen, x, y):
    """x [N, ...] in the environments that `chosen` [N] is true for, y in the others."""
    return jnp.where(chosen.reshape((-1,) + (1,) * (x.ndim - 1)), x, y)


def constants(variables) -> dict:
    """What of a network's variables is not learned."""
    return {name: value for name, value in variables.items() if name != "params"}


def descend(config: TrainConfig, variables, state, gradient, rate):
    """One step of the optimizer: (variables, its state), unchanged if the gradient is not finite.

    One broken minibatch must not spoil the weights and Adam's memory for good.
    """
    updates, new_state = optimizer(config).update(gradient, state)
    params = jax.tree.map(lambda p, u: p - rate * u, variables["params"], updates)
    finite = jnp.isfinite(optax.tree.norm(gradient))
    params, state = jax.tree.map(
        lambda new, old: jnp.where(finite, new, old),
        (params, new_state),
        (variables["params"], state),
    )
    return {**variables, "params": params}, state
