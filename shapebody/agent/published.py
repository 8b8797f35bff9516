"""The authors' published policies as agents without a critic."""

from __future__ import annotations

from collections.abc import Sequence

from shapebody.agent.agent import Agent
from shapebody.arguments import require_integer, require_list
from shapebody.design.descriptions import Sizes
from shapebody.files import data_dir
from shapebody.networks.published import read_published_policy
from shapebody.robot.robot import Robot, load_robot, require_robot


def load_published_policy(
    folder, name: str | None = None, robots: Sequence[Robot] | None = None
) -> Agent:
    """One of the policies that the paper's authors publish, as an agent without a critic.

    `training.critics.train_critics` gives it one by policy evaluation. Its files are the authors':
    save such an agent outside of what you pass on.

    Args:
        folder: with the two files of the policy, see `networks.published`.
        name: of the policy, the part of the file names before `.weights`; not needed if the folder
            holds one only.
        robots: the robots that it is to move; by default the shipped one of the policy's name.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if the name is needed, there is no robot of that name, or the files do not
            describe such a policy.
    """
    if robots is not None:
        robots = [require_robot(robot) for robot in require_list("robots", robots)]
        require_integer("the number of robots", len(robots), 1)
    policy, variables, name = read_published_policy(folder, name)
    robots = robots or [load_robot(name)]
    return Agent(
        name=f"{name}_published",
        robots=tuple(robot.name for robot in robots),
        sizes=Sizes.of(*robots),
        policy_config=policy.config,
        critic_config=None,
        policy=variables,
        critic=None,
        metadata={"published": name, "robots": [_name_or_path(robot) for robot in robots]},
    )


def _name_or_path(robot: Robot) -> str:
    """What `load_robot` finds this robot by."""
    shipped = robot.path is None or robot.path.parent == data_dir() / "robots"
    return robot.name if shipped else str(robot.path)
