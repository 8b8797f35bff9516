"""The critic ablation (Appendix B): nine critics of one policy, several seeds, the same rollouts.

    python -m tools.ablation unitree_go2
    python -m tools.ablation unitree_go2 --published downloads   # with the authors' policy

Training and comparison are added up in data/results/critic_ablation_<agent>.json. Stopped, the same
call goes on. Reckoned, not yet measured: 4 hours on two cores with the defaults.
"""

from pathlib import Path
from typing import Annotated

import tyro

from shapebody.agent.published import load_published_policy
from shapebody.agent.store import load_agent
from shapebody.reproduction.critic_ablation import critic_ablation, variants
from shapebody.robot.robot import load_robot
from shapebody.runtime import enable_compilation_cache
from shapebody.training.critics import train_critics


def main(
    robot: Annotated[str, tyro.conf.Positional],
    published: Path | None = None,
    steps: int = 1_500_000,
    seeds: int = 5,
    hours: float | None = None,
    folder: Path = Path("ablation"),
) -> None:
    """Train and compare the critics of Appendix B.

    Args:
        robot: of the shipped agent, or of the authors' policy.
        published: the folder with the authors' policies, to use theirs.
        steps: environment steps of policy evaluation.
        seeds: how many times each critic is trained.
        hours: stop training after this time.
        folder: where the run is kept.
    """
    enable_compilation_cache()
    agent = load_agent(robot) if published is None else load_published_policy(published, robot)
    seconds = None if hours is None else 3600 * hours
    run = folder / agent.name
    critics = train_critics(agent, variants(), run, steps, seeds, max_seconds=seconds)
    if critics:
        critic_ablation(agent, critics, load_robot(robot), progress=True)


if __name__ == "__main__":
    tyro.cli(main)
