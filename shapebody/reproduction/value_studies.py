"""Value against return, the share of size in a gain, and what policies are worth."""

from dataclasses import replace

import numpy as np

from shapebody.agent.agent import require_agent
from shapebody.arguments import require_flag, require_seed
from shapebody.design.space import DesignSpace
from shapebody.evaluation.evaluate import evaluate
from shapebody.files import data_dir
from shapebody.networks.published import read_published_policy
from shapebody.optimizers.objective import Objective
from shapebody.optimizers.search import METHODS, search
from shapebody.reproduction.design_study import evaluation_config, require_counts
from shapebody.reproduction.results import (
    result,
    result_in_parts,
    result_path,
    stored_parts,
    stored_result,
)
from shapebody.robot.robot import require_robot
from shapebody.training.yardstick import BODIES, yardstick


def value_against_return(
    agent,
    robot,
    designs: int = 256,
    episodes: int = 8,
    horizon: int = 1000,
    seed: int = 1000,
    progress: bool = False,
) -> list[dict]:
    """Predicted value and true return of random designs of the full design space.

    Returns:
        One record per design: its number, predicted value and mean return.
    """
    require_agent(agent)
    require_counts(designs=designs, episodes=episodes, horizon=horizon)
    require_seed("seed", seed)
    require_flag("progress", progress)
    space = DesignSpace(robot)
    f = np.stack([space.start(seed + i) for i in range(designs)])
    predicted = np.asarray(Objective.of(agent, robot, 0.0).value(f))
    config = evaluation_config(episodes, horizon)
    score = evaluate(agent, robot, f, seed=seed, config=config, progress=progress)
    return [
        {
            "design": seed + i,
            "predicted_value": float(predicted[i]),
            "return": float(score.returns[i].mean()),
        }
        for i in range(designs)
    ]


def size_share(
    agent,
    robot,
    starts: int = 10,
    episodes: int = 50,
    horizon: int = 1000,
    seed: int = 0,
    iterations: int | None = None,
) -> list[dict]:
    """How much of what VGDS (λ = 100) finds is the size of the body, and how much all the rest.

    Three entries of f scale the whole body along its axes. Every found design is taken apart into
    these (all other entries at the reference) and the rest (these at the reference), like the
    counterfactuals of the paper (Section 4.3), which put groups into the start design instead.

    Returns:
        One record per body: kept ("reference", "all", "size only", "all but size"), start number
        (None for the reference), predicted value, and the returns of all episodes.
    """
    require_agent(agent)
    require_counts(starts=starts, episodes=episodes, horizon=horizon)
    require_seed("seed", seed)
    space = DesignSpace(robot)
    short = {} if iterations is None else {"iterations": iterations}
    METHODS["vgds"].config(**short)  # refuses wrong iterations
    # The designs that are found, whole and in two parts.
    initial = np.stack([space.start(i) for i in range(starts)])
    found = search("vgds", agent, robot, initial, trust_region=100.0, seed=seed, **short).design
    size = np.zeros(space.dim, bool)
    size[space.slices["size"]] = True
    bodies = {
        "reference": space.reference[None],
        "all": found,
        "size only": np.where(size, found, 0.0),
        "all but size": np.where(size, 0.0, found),
    }
    # What all of them are worth.
    designs = np.concatenate(list(bodies.values())).astype(np.float32)
    predicted = Objective.of(agent, robot, 0.0).value(designs)
    score = evaluate(agent, robot, designs, seed=seed, config=evaluation_config(episodes, horizon))
    names = [(kept, i) for kept, rows in bodies.items() for i in range(len(rows))]
    return [
        {
            "kept": kept,
            "start": None if kept == "reference" else number,
            "predicted_value": float(value),
            "returns": [round(x, 3) for x in returns.tolist()],
        }
        for (kept, number), value, returns in zip(names, predicted, score.returns, strict=True)
    ]


def published_policy(robot, agent, folder=None, starts: int = 10, episodes: int = 16) -> dict:
    """Returns that the authors' published policy earns in our environment.

    The start designs turn frames and joint axes about our own axes, not about those of the
    authors' (`DesignSpace(published_axes_of=...)`), so the bodies differ a little from theirs.

    Args:
        robot: the robot of that policy.
        agent: any agent for it; its policy is replaced by the authors'.
        folder: with the authors' files (`networks.published`). If it is not given, the stored
            result is returned.
        starts, episodes: start designs, and evaluation episodes per design.

    Returns:
        {"records": ..., "provenance": ...} with records of the reference and of the starts as in
        `design_study`, without what a critic has to say.

    Raises:
        FileNotFoundError: if nothing is stored and no folder is given.
    """
    require_robot(robot)
    require_agent(agent)
    require_counts(starts=starts, episodes=episodes)
    name = f"published_policy_{robot.name}"
    if folder is None:
        # The authors' policy is the same at all scales.
        for path in (result_path(name), data_dir() / "results" / f"{name}.json"):
            if path.exists():
                return stored_result(path)
        raise FileNotFoundError(
            f"{path.name} does not exist in data/results; give the folder of the authors' weights"
        )

    def compute():
        module, variables, _ = read_published_policy(folder, robot.name)
        theirs = replace(agent, name="published", policy_config=module.config, policy=variables)
        space = DesignSpace(robot)
        rows = [("reference", None, space.reference)]
        rows += [("start", i, space.start(i)) for i in range(starts)]
        score = evaluate(theirs, robot, np.stack([f for *_, f in rows]), episodes)
        return [
            {
                "origin": origin,
                "start": number,
                "return": float(score.returns[i].mean()),
                "tracking_error": float(score.tracking_error[i].mean()),
                "length": float(score.lengths[i].mean()),
                "engine": score.settings["engine"],
                "returns": [round(value, 3) for value in score.returns[i].tolist()],
            }
            for i, (origin, number, _) in enumerate(rows)
        ]

    return result(name, compute, recompute=True, starts=starts, episodes=episodes)


def policy_yardstick(
    robot, agent, folder=None, bodies: int = BODIES, recompute: bool = False
) -> dict:
    """The yardstick of an agent's policy and, where it is at hand, of the authors' published one.

    Args:
        robot: the robot of both policies.
        agent: whose policy is measured.
        folder: with the authors' files (`networks.published`). If it is not given, the stored
            records of their policy are added, if there are any.
        bodies: number B of bodies.
        recompute: measure the agent's policy again, and the authors' if `folder` is given.

    Returns:
        {"records": ..., "provenance": ...} with a record per policy ("shipped", "published") and
        coefficient c (1 and 0.5): success (0 or 1), returns and lengths of the B bodies.
    """
    require_robot(robot)
    require_agent(agent)
    require_counts(bodies=bodies)
    require_flag("recompute", recompute)
    # Read before anything is measured.
    theirs = None if folder is None else read_published_policy(folder, robot.name)

    def measured(policy, config, variables):
        records = []
        for c in (1.0, 0.5):
            one = yardstick(config, variables, robot, c, bodies)
            records.append(
                {
                    "policy": policy,
                    "coefficient": c,
                    "success": one.success.astype(int).tolist(),
                    "returns": [round(value, 3) for value in one.returns.tolist()],
                    "lengths": one.lengths.tolist(),
                }
            )
        return records

    def published():
        module, variables, _ = theirs
        return measured("published", module.config, variables)

    name = f"yardstick_{robot.name}"
    parts = {"shipped": lambda: measured("shipped", agent.policy_config, agent.policy)}
    settings = {"shipped": {"policy": agent.policy_hash}}
    if recompute:
        again = parts if theirs is None else {**parts, "published": published}
        result_in_parts(name, again, recompute=True, settings=settings, bodies=bodies)
    if theirs is not None or "published" in stored_parts(name, bodies=bodies):
        parts["published"] = published
    return result_in_parts(name, parts, settings=settings, bodies=bodies)
