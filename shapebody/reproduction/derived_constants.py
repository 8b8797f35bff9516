"""How much returns depend on MuJoCo's derived constants."""

import numpy as np

from shapebody.arguments import require_integer
from shapebody.design.space import DesignSpace
from shapebody.evaluation.evaluate import EvaluationConfig, evaluate
from shapebody.task.config import TaskConfig


def derived_constants(
    agent, robot, starts: int = 10, episodes: int = 16, seed: int = 0, horizon: int = 1000
) -> list[dict]:
    """Returns with MuJoCo's derived constants (`body_invweight0` and the like) kept and recomputed.

    data/results/derived_constants_go2.json is `result("derived_constants_go2", ...)` of this.

    The paper's environment leaves them at the reference when a body changes, and so do we; the
    native engine can recompute them for every design.

    Returns:
        One record per design (the reference, then the starts): mean return with the reference's
        constants, with recomputed ones, and the standard error of their paired difference.
    """
    space = DesignSpace(robot)
    require_integer("starts", starts, 0, 100_000)
    require_integer("episodes", episodes, 2, 1_000_000)  # a standard error needs two
    designs = np.stack([space.reference] + [space.start(i) for i in range(starts)])
    task = TaskConfig.evaluation(horizon=horizon)

    def returns(recompute: bool):
        config = EvaluationConfig(episodes=episodes, recompute_constants=recompute, task=task)
        return evaluate(agent, robot, designs, seed=seed, engine="native", config=config).returns

    kept, recomputed = returns(False), returns(True)
    difference = recomputed - kept
    return [
        {
            "design": "reference" if i == 0 else f"start {i - 1}",
            "return": float(kept[i].mean()),
            "return_recomputed": float(recomputed[i].mean()),
            "standard_error": float(difference[i].std(ddof=1) / np.sqrt(episodes)),
        }
        for i in range(len(designs))
    ]
