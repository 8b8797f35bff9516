"""Several critics of one policy, judged by what they are for: order bodies, and find better ones.

All search from the same start designs (Section 4.1), and are compared with penalty only.
"""

import numpy as np

from shapebody.agent.agent import require_agent
from shapebody.arguments import (
    require_integer,
    require_kind,
    require_list,
    require_number,
    require_records,
    require_seed,
)
from shapebody.design.space import DesignSpace
from shapebody.evaluation.evaluate import EvaluationConfig, evaluate
from shapebody.evaluation.statistics import paired_gain, rank_correlation
from shapebody.optimizers.objective import Objective
from shapebody.optimizers.search import search
from shapebody.reproduction.results import result, result_in_parts
from shapebody.reproduction.value_studies import value_against_return
from shapebody.task.config import TaskConfig


def compare_critics(
    critics: dict,
    robot,
    trust_regions=(20.0, 100.0),
    starts: int = 10,
    first_start: int = 30,
    episodes: int = 50,
    horizon: int = 1000,
    seed: int = 0,
) -> list[dict]:
    """VGDS with each critic and each λ, and penalty only, on the same episodes.

    Args:
        critics: by name, agents for `robot` with one and the same policy.
        trust_regions: the λ.
        starts, first_start: number of start designs, and the number of the first. The paper's are
            0 to 9; on those from 30 on, no setting has been chosen here.
        episodes, horizon, seed: of the evaluation.

    Returns:
        One record per found design: critic and trust_region (None for penalty only), start
        number, the returns of all episodes, tracking error (m/s), length (control steps), the three
        entries of f that scale the body along its axes, and the distance |f - f_ref| / sqrt(d).

    Raises:
        ValueError: if the critics belong to different policies.
    """
    _require_critics(critics)
    trust_regions = require_list("trust_regions", trust_regions)
    for value in trust_regions:
        require_number("a number in trust_regions", value, 0)
    for name, value in (("starts", starts), ("episodes", episodes), ("horizon", horizon)):
        require_integer(name, value, 1, 1_000_000)
    require_integer("first_start", first_start)
    require_seed("seed", seed)
    policies = {agent.policy_hash for agent in critics.values()}
    if len(policies) != 1:
        raise ValueError(
            f"the critics {', '.join(critics)} belong to {len(policies)} policies; expected one, "
            "or the returns differ for another reason"
        )
    space = DesignSpace(robot)
    # The searches.
    numbers = range(first_start, first_start + starts)
    initial = np.stack([space.start(i) for i in numbers])
    first = next(iter(critics.values()))

    # Penalty only asks no critic, so any agent will do.
    found = {(None, None): search("penalty-only", first, robot, initial, seed=seed).design}
    for name, agent in critics.items():
        for value in trust_regions:
            run = search("vgds", agent, robot, initial, trust_region=value, seed=seed)
            found[name, value] = run.design

    # The episodes, the same for all found designs.
    designs = np.concatenate(list(found.values()))
    config = EvaluationConfig(episodes=episodes, task=TaskConfig.evaluation(horizon=horizon))
    score = evaluate(first, robot, designs, seed=seed, config=config)
    rows = [(*key, number) for key in found for number in numbers]
    return [
        {
            "critic": name,
            "trust_region": value,
            "start": number,
            "returns": [round(x, 3) for x in score.returns[i].tolist()],
            "tracking_error": float(score.tracking_error[i].mean()),
            "length": float(score.lengths[i].mean()),
            "size": [round(x, 4) for x in designs[i, space.slices["size"]].tolist()],
            "distance": float(np.sqrt(np.mean(designs[i] ** 2))),
        }
        for i, (name, value, number) in enumerate(rows)
    ]


def _require_critics(critics) -> None:
    require_kind("critics", critics, dict, "agents by name")
    if not critics:
        raise ValueError("critics is {}; expected at least one agent by name")
    for agent in critics.values():
        require_agent(agent)


def critic_gains(records: list[dict]) -> list[dict]:
    """What each critic adds to penalty only, from the records of `compare_critics`.

    Returns:
        One row per critic and λ: mean gain in return with its 95 % interval over starts and
        episodes (low, high), the number of starts and of those that gain, mean tracking error
        (m/s), mean length (control steps) and mean size entries [3]; first penalty only, whose
        gain is None.
    """
    groups: dict = {}
    columns = ("critic", "trust_region", "returns", "tracking_error", "length", "size")
    for record in require_records("records", records, columns):
        groups.setdefault((record["critic"], record["trust_region"]), []).append(record)
    if (None, None) not in groups:
        raise ValueError("records hold no penalty only; expected those of compare_critics")
    penalty = [record["returns"] for record in groups[None, None]]
    rows = []
    for (critic, value), group in groups.items():
        row = {"critic": critic, "trust_region": value, "pairs": len(group)}
        row |= dict.fromkeys(("mean", "low", "high", "positive"))
        if critic is not None:
            gain = paired_gain([record["returns"] for record in group], penalty)
            positive = int(np.sum(gain.differences > 0))
            row |= dict(mean=gain.mean, low=gain.low, high=gain.high, positive=positive)
        for name in ("tracking_error", "length"):
            row[name] = float(np.mean([record[name] for record in group]))
        row["size"] = np.mean([record["size"] for record in group], axis=0).tolist()
        rows.append(row)
    return rows


def critic_correlations(critics: dict, robot, records: list[dict]) -> dict[str, tuple]:
    """Spearman's ρ of each critic's value and the return, with its 95 % interval.

    Args:
        records: of `value_against_return` for the policy that all critics share; the designs and
            the returns in them do not depend on a critic.
    """
    _require_critics(critics)
    space = DesignSpace(robot)
    if len(require_records("records", records, ("design", "return"))) < 3:
        raise ValueError(f"records has {len(records)} entries; expected three or more")
    designs = np.stack([space.start(record["design"]) for record in records])
    returns = [record["return"] for record in records]
    return {
        name: rank_correlation(Objective.of(agent, robot, 0.0).value(designs), returns)
        for name, agent in critics.items()
    }


def critic_tasks(old, new, robot, **changes) -> dict:
    """Is a critic better that was trained on the task on which designs are evaluated?

    data/results/critic_tasks_<robot>.json is this with `new`, the shipped agent, and `old`, the one
    shipped before it (in the history of this repository, commit 1568810). Its critic was trained
    for as many steps on the task of the policy's training: `train_critic(new,
    CriticConfig.sharp(), 6_000_000, task_of="training")`.

    Args:
        changes: settings of `compare_critics`.

    Returns:
        {"records": ..., "provenance": ...} with the records of `compare_critics`, and one of each
        critic's rank correlation over 256 random designs: critic, rho, low, high.
    """
    critics = {"task of the training": old, "task of the evaluation": new}
    setting = {"starts": 10, "first_start": 30, "episodes": 50, "horizon": 1000, **changes}
    values = {"designs": 256, "episodes": 8, "horizon": setting["horizon"]}

    def correlations():
        name = f"value_against_return_{robot.name}"
        random = result(name, lambda: value_against_return(new, robot, **values), new, **values)
        found = critic_correlations(critics, robot, random["records"])
        return [
            {"critic": name, "rho": rho, "low": low, "high": high}
            for name, (rho, low, high) in found.items()
        ]

    parts = {
        "found designs": lambda: compare_critics(critics, robot, **setting),
        "rank correlation": correlations,
    }
    name = f"critic_tasks_{robot.name}"
    return result_in_parts(name, parts, new, **setting, old=old.hash)
