"""Several critics of one policy, judged by what they are for: order bodies, and find better ones.

All search from the same start designs (Section 4.1), and are compared with penalty only.
"""

from functools import partial

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
from shapebody.networks.config import CriticConfig
from shapebody.networks.inputs import count_parameters
from shapebody.optimizers.objective import Objective
from shapebody.optimizers.search import search
from shapebody.reproduction import paper
from shapebody.reproduction.results import result, result_in_parts
from shapebody.reproduction.value_studies import value_against_return
from shapebody.task.config import TaskConfig
from shapebody.training.critics import held_out_scores


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


# ------------------------------------------------------------------ the ablation of Appendix B


def variants() -> dict[str, CriticConfig]:
    """The nine critics of Appendix B at the widths of `reduced`, such as "direct-design 3x32".

    The name has the number of heads and the value latent, which is the same for joints and feet.
    """
    return {
        f"{kind} {heads}x{latent}": CriticConfig.reduced(
            kind=kind, heads=heads, joint_value_latent=latent, foot_value_latent=latent
        )
        for kind, heads, latent, _ in paper.CRITIC_ABLATION
    }


def critic_ablation(agent, critics: dict, robot, progress: bool = False, **changes) -> dict:
    """What critics of one policy are worth, each trained from several seeds (Appendix B).

    data/results/critic_ablation_<agent>.json is this with `train_critics(agent, variants(), ...,
    seeds=5)`; the script is tools/ablation.py.

    Args:
        agent: whose policy it is.
        critics: agents by name, as `train_critics` returns them: a variant's seeds are named
            "<variant>, seed <number>".
        robot: its robot.
        progress: print a line per part that is computed.
        changes: settings of `compare_critics`; by default λ = 100 from the paper's ten starts, 50
            episodes.

    Returns:
        {"records": ..., "provenance": ...}: the records of `compare_critics`, and for each critic
        one of how well it predicts (critic, parameters, rho with low and high over 256 random
        designs, explained_variance and rmse on bodies never seen).
    """
    require_agent(agent)
    _require_critics(critics)
    setting = {"starts": 10, "first_start": 0, "episodes": 50, "horizon": 1000, **changes}
    groups: dict[str, dict] = {}
    for name, one in critics.items():
        groups.setdefault(name.partition(", seed ")[0], {})[name] = one

    def predictions():
        first = next(iter(critics.values()))
        random = value_against_return(first, robot, horizon=setting["horizon"])
        rho, scores = critic_correlations(critics, robot, random), held_out_scores(agent, critics)
        return [
            {
                "critic": name,
                "parameters": count_parameters(critics[name].critic["params"]),
                **dict(zip(("rho", "low", "high"), map(float, rho[name]), strict=True)),
                **scores[name]._asdict(),
            }
            for name in critics
        ]

    def found(variant):
        records = compare_critics(groups[variant], robot, (100.0,), **setting)
        # Penalty only is the same for all, and kept once.
        first = variant == next(iter(groups))
        return [record for record in records if first or record["critic"] is not None]

    parts = {name: partial(found, name) for name in groups}
    return result_in_parts(
        f"critic_ablation_{agent.name}",
        {"predictions": predictions, **parts},
        progress=progress,
        policy=agent.policy_hash,
        critics={name: one.hash for name, one in critics.items()},
        **setting,
    )
