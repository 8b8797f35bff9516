"""The settings of a training run."""

import os
from dataclasses import field
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BeforeValidator

from shapebody.arguments import refuse, require_choice, require_list, require_name, require_path
from shapebody.configuration import (
    FileName,
    Flag,
    NonNegative,
    Pair,
    Positive,
    Probability,
    Seed,
    Threshold,
    configuration,
    expecting,
    integer,
)
from shapebody.files import data_dir
from shapebody.networks.config import CriticConfig, PolicyConfig
from shapebody.robot.robot import find
from shapebody.task.config import TaskConfig

MOST_STEPS = 10**15
"""Largest number of environment steps."""

SCALES = ("smoke", "reduced", "full")
"""Names of the sizes at which everything can be computed."""


def as_robots(robots) -> tuple[str, ...]:
    """One name or path, or a list of them, as a tuple of texts; ValueError for none."""
    single = isinstance(robots, str | Path)
    robots = (robots,) if single else require_list("robots", robots, 1000)
    if not robots:
        raise refuse("robots", robots, "at least one name or path of a robot")
    for robot in robots:
        robot_name(robot)
    return tuple(str(robot) for robot in robots)


Size = integer(1, 2**24)
Robots = Annotated[
    tuple[str, ...],
    BeforeValidator(as_robots),
    expecting("at least one name or path of a robot"),
]


@configuration
class TrainConfig:
    """A training run. Defaults are the paper's single-robot run (Appendix A, PPO table)."""

    name: FileName
    """Name of the agent and of its folder in data/checkpoints."""
    robots: Robots
    """Robots to train on, names or paths; environments are shared out evenly."""
    scale: Literal["smoke", "reduced", "full"] = "full"
    """Name of the sizes; `at_scale` chooses all that belongs to them."""
    seed: Seed = 0
    """Seed of everything that is drawn."""

    policy: PolicyConfig = field(default_factory=PolicyConfig)
    """Sizes of the policy."""
    critic: CriticConfig = field(default_factory=CriticConfig)
    """Sizes of the critic."""
    standardize: Flag = False
    """Standardize the network's inputs over the design distribution."""

    num_envs: Size = 4096
    """Environments that run side by side."""
    rollout_length: Size = 64
    """Control steps per environment and iteration."""
    total_steps: integer(1, MOST_STEPS) = 1_000_000_000
    """Environment steps of the whole run."""
    minibatch_size: Size = 16_384
    """Control steps per gradient step: whole environments times the rollout length. If it does not
    divide the batch (15,040 environments), every epoch leaves out some environments at random."""
    epochs: Size = 10
    """Passes over each rollout."""
    learning_rate: Pair = (1.5e-3, 3e-4)
    """At the first and at the last step; linear between."""
    discount: Probability = 0.99
    """Discount factor γ per control step."""
    gae_lambda: Probability = 0.7
    """The GAE parameter of advantages."""
    value_lambda: Probability | None = None
    """gae_lambda of the critic's targets, if not the same. With short rollouts and few gradient
    steps, a small one makes the critic learn slowly what lasts longer than 1 / (1 - lambda) steps.
    """
    cut_at_commands: Flag = False
    """The policy's advantages end where the command changes, as if the episode were truncated. No
    action causes that change, so what the new command is worth is only noise to the policy."""
    clip_range: Positive = 0.1
    """Half-width of the interval about 1 to which probability ratios are clipped."""
    entropy_coefficient: NonNegative = 0.005
    """Weight of the policy's entropy in its loss."""
    max_gradient_norm: Positive = 3.0
    """Gradients with a larger norm are scaled down to it."""
    average_half_life: Positive | None = None
    """Half-life, in environment steps, of the running average of the policy's weights that a saved
    agent has for its policy; None: no average. Gradient steps of a large learning rate walk at
    random around a better policy, and an average takes that walk out."""
    average_proximal: Flag = False
    """Whether the trust region lies around that average (PPO-EWMA, Hilton et al., 2022) instead of
    the policy at the start of the iteration."""
    mirror_coefficient: NonNegative = 0.0
    """Weight of the mirror loss: the squared difference, summed over joints, between the action
    means on a body and the mirrored ones on its mirror image (`design.mirror`). 0: without. A sum,
    so the same weight is more for a robot with more joints."""
    mirrored_critic: Flag = False
    """Whether the critic learns a random half of each rollout as its mirror image. An exact state
    (training.safetensors) of a run without mirror images does not go on with them."""
    kl_threshold: Threshold = 0.5
    """The rest of an iteration's updates is skipped once a minibatch exceeds this; inf: never."""

    task: TaskConfig = field(default_factory=TaskConfig)
    """Settings of the locomotion task."""
    learn_policy: Flag = True
    """False in the policy-evaluation phase: only the critic learns, at c = 1."""
    mean_actions: Flag = False
    """Act without exploration noise, as in evaluation; only if the policy does not learn."""
    state_bank: Size = 2048
    """States kept for design search."""
    yardstick_interval: integer(1, MOST_STEPS) | None = 2_000_000
    """Environment steps between two measurements of the policy on fixed random bodies
    (`training.yardstick`), for the learning curve; None: never."""

    def __post_init__(self):
        names = [robot_name(robot) for robot in self.robots]
        if len(set(names)) < len(names):
            raise ValueError(
                f"robots is {self.robots!r}; expected robots of different names: a robot is known "
                "by the name of its file, so leave out repeated ones, or copy a file to another "
                "name"
            )
        if self.learn_policy and self.mean_actions:
            raise ValueError(
                "mean_actions is True, but a policy learns from its exploration; expected "
                "learn_policy=False with it"
            )
        if self.average_proximal and self.average_half_life is None:
            raise ValueError(
                "average_proximal is True, but there is no average; expected average_half_life in "
                "environment steps with it, such as 1e6"
            )
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
    def mirrors(self) -> bool:
        """Whether something is learned from mirror images."""
        return self.mirror_coefficient > 0 or self.mirrored_critic

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
            "yardstick_interval": None,
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
    return "+".join(robot_name(name) for name in as_robots(robots))


def robot_name(name_or_path) -> str:
    """The name of a robot that is given by name or file, without reading the file."""
    path = require_path("robot", name_or_path)
    return require_name("the name of the robot's file", path.stem)


def located(robot: str) -> str:
    """A robot as runs store it: a shipped one by name, a file by its absolute path, so that it is
    the same robot in every working directory."""
    try:
        path = find(robot)
    except (ValueError, OSError):
        return robot  # which `load_robot` reports
    # Links are not followed: the robot's name is that of the file as it was given.
    return robot if path == data_dir() / "robots" / f"{robot}.xml" else os.path.abspath(path)
