"""Many critics of one frozen policy, trained on the same rollouts.

Simulation is what policy evaluation spends most of its time on. Critics that are compared see the
same bodies and states here, each simulated once, so that nothing but the critics differs.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from shapebody.agent.agent import Agent, require_agent
from shapebody.arguments import (
    require_engine,
    require_integer,
    require_kind,
    require_name,
    require_path,
)
from shapebody.configuration import to_json
from shapebody.files import atomic_write
from shapebody.networks.config import CriticConfig
from shapebody.networks.critic import Critic
from shapebody.networks.inputs import initialize
from shapebody.networks.policy import Policy
from shapebody.robot.robot import load_robot
from shapebody.stored import read_json
from shapebody.task.env import Locomotion
from shapebody.training.config import MOST_STEPS, TrainConfig, located
from shapebody.training.policy_evaluation import evaluation_config
from shapebody.training.progress import announce
from shapebody.training.rollout import make_policy_function
from shapebody.training.run_state import require_budget, require_own_config
from shapebody.training.train import run_or_interrupt
from shapebody.training.trainer import Trainer
from shapebody.training.update import Learner, optimizer, ppo_update

CRITICS = "critics.json"
"""File of the run's folder with the configurations of its critics."""
MOST_CRITICS = 1000


class CriticScores(NamedTuple):
    """How well a critic predicts the discounted returns of bodies that it never saw."""

    explained_variance: float
    """1 - the variance of the errors over the variance of the returns."""
    rmse: float
    """Root of the mean squared error."""


class CriticsTrainer(Trainer):
    """A `Trainer` of policy evaluation with more critics than that of its configuration.

    Args:
        configs: the run, once for every critic, by name; they differ in `critic` alone.
        seeds: of each critic's first weights and order of minibatches, by name.
        folder, engine, policy: as `Trainer`.
    """

    def __init__(self, configs: Mapping[str, TrainConfig], seeds, folder, engine, policy):
        first = next(iter(configs))
        super().__init__(configs[first], folder, engine, policy)
        self.configs, self.seeds = dict(configs), dict(seeds)
        constants = self.learner.critic.get("constants")
        self.learners: dict[str, Learner] = {}
        for name, config in self.configs.items():
            key = jax.random.fold_in(jax.random.PRNGKey(config.seed), self.seeds[name])
            critic = initialize(Critic(config.critic), key, constants)
            state = optimizer(config).init(critic["params"])
            self.learners[name] = replace(self.learner, critic=critic, critic_optimizer=state)
        self.learner = self.learners[first]

    def everything(self) -> dict:
        """What determines the run's future, with the critics and their optimizers."""
        critics = {
            name: {"critic": one.critic, "optimizer": one.critic_optimizer}
            for name, one in self.learners.items()
        }
        return {**super().everything(), "critics": critics}

    def _take(self, saved: dict) -> None:
        super()._take(saved)
        for name, one in saved["critics"].items():
            self.learners[name] = replace(
                self.learner, critic=one["critic"], critic_optimizer=one["optimizer"]
            )

    def _learn(self, trajectory, number: int) -> dict[str, float]:
        """Let every critic learn from rollout `number`; the metrics of the first one."""
        metrics = {}
        for name, config in self.configs.items():
            key = jax.random.fold_in(self.key, 2 * number + 1)
            key = jax.random.fold_in(key, self.seeds[name])
            self.learners[name], found = ppo_update(config, self.learners[name], trajectory, key)
            metrics = metrics or {key: float(x) for key, x in found.items()}
        self.learner = next(iter(self.learners.values()))
        return metrics


def train_critics(
    agent: Agent,
    critics: Mapping[str, CriticConfig],
    folder: str | Path,
    steps: int | None = None,
    seeds: int = 1,
    progress: bool = True,
    max_seconds: float | None = None,
    engine: str = "auto",
    **changes,
) -> dict[str, Agent]:
    """Policy evaluation with many critics at once, on the task on which designs are evaluated.

    The same as `train_critic`, whose docstring says what the critics learn, but with one pass of
    rollouts for all of them. The agent may be one without a critic (`load_published_policy`).

    Args:
        agent: its policy is kept.
        critics: sizes of the new critics, by name.
        folder: of the run's state and curve, which shows the first critic. A run that was stopped
            is continued by the same call; a later call with more `steps` goes on from there.
        steps: environment steps; 6 million at `reduced` if not given.
        seeds: how many times each critic is trained, from other first weights and with another
            order of minibatches.
        progress, max_seconds, engine: see `train`.
        changes: replace fields of the TrainConfig, see `train_critic`.

    Returns:
        An agent for every critic, by its name and, with several seeds, ", seed 0" and so on; all
        have the same state bank. Empty if the run was stopped before its end.

    Raises:
        ValueError: for no critics, if the run in the folder has other critics or settings, or if
            the agent does not say how its policy was trained.
    """
    require_agent(agent)
    require_kind("critics", critics, Mapping, "of shapebody.CriticConfig by name")
    require_integer("the number of critics", len(critics), 1, MOST_CRITICS)
    for name, critic in critics.items():
        require_name("a name in critics", name)
        require_kind(f"critics[{name!r}]", critic, CriticConfig, "shapebody.CriticConfig.sharp()")
    require_integer("seeds", seeds, 1, MOST_CRITICS)
    if steps is not None:
        require_integer("steps", steps, 1, MOST_STEPS)
    require_engine("engine", engine)
    require_budget(None, max_seconds, progress)
    folder = require_path("folder", folder)
    configs, numbers = {}, {}
    for name, critic in critics.items():
        config = evaluation_config(agent, critic, steps, **changes)
        for seed in range(seeds):
            label = f"{name}, seed {seed}" if seeds > 1 else name
            configs[label], numbers[label] = config, seed
    first = next(iter(configs.values()))
    longer = ("total_steps",)
    _require_own_critics(folder, configs)
    require_own_config(folder, first, longer)
    announce(engine, len(first.robots), progress)
    trainer = CriticsTrainer(configs, numbers, folder, engine, agent.policy)
    with trainer.alone():
        trainer.start(changeable=longer)
        atomic_write(trainer.folder / CRITICS, _critics_text(configs))
        run_or_interrupt(trainer, progress, max_seconds=max_seconds)
        if trainer.steps < first.iterations * first.batch:
            return {}
        found = trainer.agent(trainer.state_bank())
    return {
        name: replace(
            found,
            name=agent.name,
            critic_config=configs[name].critic,
            critic=learner.critic,
            metadata=agent.metadata | {"policy_evaluation": _phase(found, configs[name], name)},
        )
        for name, learner in trainer.learners.items()
    }


def _phase(found: Agent, config: TrainConfig, name: str) -> dict:
    """What the metadata of an agent say of its policy evaluation."""
    known = {key: found.metadata[key] for key in ("steps", "seconds")}
    return {"config": to_json(config), **known, "critic": name}


def _critics_text(configs: Mapping[str, TrainConfig]) -> str:
    sizes = {name: to_json(config)["critic"] for name, config in configs.items()}
    return json.dumps(sizes, indent=1) + "\n"


def _require_own_critics(folder: Path, configs: Mapping[str, TrainConfig]) -> None:
    """ValueError if the run in the folder trains other critics."""
    path = folder / CRITICS
    if not path.exists():
        return
    known = read_json(path, "restore it, or choose another folder")
    if known != json.loads(_critics_text(configs)):
        raise ValueError(
            f"the run in {folder} trains other critics ({', '.join(known)}); give the same ones in "
            "the same order, or choose another folder"
        )


# ---------------------------------------------------------------------- bodies never seen

HELD_OUT = 1_000_003
"""Folded into the keys of bodies and episodes on which critics are compared, never trained."""
AHEAD = 500
"""Control steps of which a return consists; what follows counts less than 0.99^500 = 0.007."""


def held_out_scores(
    agent: Agent,
    critics: Mapping[str, Agent],
    bodies: int = 256,
    moments: int = 8,
    seed: int = 0,
    engine: str = "auto",
) -> dict[str, CriticScores]:
    """Compare critics with returns on bodies that none of them was trained on.

    One episode of each body, f ~ U([-r, r]^d) with r ~ U(0, 1), with mean actions in the task on
    which designs are evaluated. Of every episode, `moments` states of its first two seconds are
    judged: their return is the discounted sum of the rewards of the following 10 s, or until a
    fall.

    Args:
        agent: whose policy walks; of one robot.
        critics: agents with the critics, by name, such as `train_critics` returns.
        bodies, moments: their numbers.
        seed: of bodies, episodes and moments.
        engine: "native", "mjx" or "auto".
    """
    require_agent(agent)
    require_kind("critics", critics, Mapping, "of agents by name")
    for name, value in (("bodies", bodies), ("moments", moments)):
        require_integer(name, value, 1, 100_000)
    require_integer("seed", seed, 0)
    require_engine("engine", engine)
    config = evaluation_config(agent, CriticConfig.sharp())
    robots = [load_robot(located(name)) for name in config.robots]
    task = replace(config.task, horizon=AHEAD + 100, fixed_coefficient=True)
    env = Locomotion(robots, bodies, engine, task, auto_reset=False)
    act = make_policy_function(Policy(agent.policy_config), mean_actions=True)
    key = jax.random.fold_in(jax.random.PRNGKey(seed), HELD_OUT)
    state = env.reset(key, coefficient=1.0)
    _, episode = env.rollout(act, agent.policy, state, key, AHEAD + 100)

    # Discounted returns of the next AHEAD steps, until the end of the episode.
    reward, ended = np.asarray(episode.reward), np.asarray(episode.terminated)
    alive = np.cumsum(ended, axis=0) - ended == 0
    reward = np.where(alive, reward, 0.0)
    weights = config.discount ** np.arange(AHEAD)
    rng = np.random.default_rng(seed)
    when = rng.integers(0, 100, (moments, bodies))
    who = np.broadcast_to(np.arange(bodies), when.shape)
    returns = np.zeros(when.shape)
    for t in range(AHEAD):
        returns += weights[t] * reward[when + t, who]
    good = alive[when, who]
    seen = jax.tree.map(lambda x: np.asarray(x)[when, who], episode.observation)
    described = jax.tree.map(lambda x: np.asarray(x)[0][who], episode.descriptions)
    scores = {}
    for name, one in critics.items():
        error = (np.asarray(one.values(described, seen)).mean(-1) - returns)[good]
        scores[name] = CriticScores(
            float(1 - np.var(error) / np.var(returns[good])), float(np.sqrt(np.mean(error**2)))
        )
    return scores
