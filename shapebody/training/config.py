"""The settings of a training run."""

import math
import os
from dataclasses import dataclass, field
from pathlib import Path

from shapebody.arguments import (
    refuse,
    require_choice,
    require_flag,
    require_integer,
    require_kind,
    require_list,
    require_name,
    require_number,
    require_path,
    require_seed,
)
from shapebody.files import data_dir
from shapebody.networks.config import CriticConfig, PolicyConfig
from shapebody.robot.robot import find
from shapebody.task.config import TaskConfig

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
