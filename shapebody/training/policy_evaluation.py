"""Policy evaluation: the policy is frozen, and only critics learn."""

from dataclasses import replace
from pathlib import Path

from shapebody.agent.agent import Agent, require_agent
from shapebody.agent.store import chosen_folder, load_agent, save_agent
from shapebody.arguments import (
    require_choice,
    require_engine,
    require_integer,
    require_kind,
    require_path,
)
from shapebody.configuration import from_json
from shapebody.networks.config import CriticConfig
from shapebody.task.config import TaskConfig
from shapebody.training.config import MOST_STEPS, TrainConfig, as_robots
from shapebody.training.progress import announce
from shapebody.training.replacing import metadata_in
from shapebody.training.run_state import require_budget, require_own_config, require_same_robots
from shapebody.training.train import run_or_interrupt
from shapebody.training.trainer import Trainer


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
    commands for a merit of small bodies. Notebook 06 compares the two: at λ = 100 the newer way
    finds better bodies for all three robots, at λ = 20 worse ones for the MIT Humanoid.

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
    require_budget(None, max_seconds, progress)
    folder = _folder_for(agent) if folder is None else require_path("folder", folder)
    config = evaluation_config(agent, critic, steps, task_of, **changes)
    # The state belongs to this policy: another one starts anew.
    own, longer = folder / f"critic_{agent.policy_hash[:8]}", ("total_steps",)
    require_own_config(own, config, longer)
    announce(engine, len(config.robots), progress)
    trainer = Trainer(config, own, engine, agent.policy)
    phases = agent.metadata.get("phases") or [{}]
    require_same_robots(phases[0].get("robots", {}), trainer.env.robots, f"agent {agent.name!r}")
    with trainer.alone():
        trainer.start(changeable=longer)
        run_or_interrupt(trainer, progress, max_seconds=max_seconds)
        if trainer.steps < config.iterations * config.batch:
            return agent
        new = trainer.agent(trainer.state_bank())
        phase = {name: new.metadata[name] for name in ("config", "steps", "seconds")}
        new = replace(new, metadata={**agent.metadata, "policy_evaluation": phase})
        save_agent(new, folder)
    return new


def _folder_for(agent: Agent) -> Path:
    """data/checkpoints/<agent>; ValueError if another policy is there.

    The agent may come from elsewhere, and its name be that of another one here.
    """
    folder = chosen_folder(None, agent.name)
    if metadata_in(folder) and load_agent(folder).policy_hash != agent.policy_hash:
        raise ValueError(
            f"the agent in {folder} has another policy than agent {agent.name!r}, whose new "
            "critic would be saved there; give its own folder (folder=...)"
        )
    return folder


def evaluation_config(
    agent: Agent,
    critic: CriticConfig,
    steps: int | None = None,
    task_of: str = "evaluation",
    **changes,
) -> TrainConfig:
    """The configuration of the policy evaluation of an agent; arguments as in `train_critic`.

    Raises:
        ValueError: if the agent does not say how its policy was trained.
    """
    published = "published" in agent.metadata  # nothing is known of its training
    missing = [name for name in ("config", "scale") if name not in agent.metadata]
    if missing and not published:
        raise ValueError(
            f"the metadata of agent {agent.name!r} lack {missing[0]!r}, which says how its policy "
            "was trained; restore its agent.json, or train it anew"
        )
    if published:
        robots = as_robots(agent.metadata.get("robots", list(agent.robots)))
        trained = TrainConfig.reduced(robots[0], robots=robots)
    else:
        what = f"metadata of agent {agent.name!r}: config"
        trained = from_json(TrainConfig, agent.metadata["config"], what)
    scale = agent.metadata.get("scale", trained.scale)
    base = TrainConfig.at_scale(scale, trained.robots[0], name=agent.name)
    length = max(base.rollout_length, 32)
    task = TaskConfig.evaluation() if task_of == "evaluation" else trained.task
    settings = {
        # Robots by the names or files they were trained from.
        "robots": trained.robots,
        "seed": trained.seed,
        "policy": agent.policy_config,
        "critic": critic,
        "standardize": True,
        "learn_policy": False,
        "yardstick_interval": None,
        "average_half_life": None,
        "average_proximal": False,
        "mean_actions": True,
        "epochs": 1,
        "discount": trained.discount,
        "gae_lambda": 0.95,
        "value_lambda": None,
        # Returns with that λ look further ahead than short rollouts reach.
        "num_envs": base.batch // length,
        "rollout_length": length,
        "total_steps": base.total_steps * 12 // 100 if steps is None else steps,
        "task": replace(task, horizon=200, design_radius=(0.0, 1.0)),
    }
    return replace(base, **settings | changes)
