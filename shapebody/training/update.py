"""One PPO iteration of the learner."""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import optax

from shapebody.arguments import require_flag, require_kind
from shapebody.networks.critic import Critic
from shapebody.networks.policy import Policy, entropy, log_prob
from shapebody.task.env import Trajectory
from shapebody.training.config import TrainConfig
from shapebody.training.losses import advantages, command_changes


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Learner:
    """Everything the learner changes."""

    policy: Any  # variables of Policy.apply
    critic: Any  # variables of Critic.apply
    policy_optimizer: Any
    critic_optimizer: Any
    iteration: jax.Array  # [] int32, finished iterations


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
