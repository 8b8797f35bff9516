"""Exercises of 03_locomotion_task."""

import numpy as np

from exercises import checker, need, same
from shapebody.task.rewards import TERMS, combine


@checker
def check_reward(function):
    """The reward of one step from its 23 unweighted terms and the coefficient c."""

    def right(c, *amounts):
        """Whether the function is right where these terms, and no others, count so much."""
        terms = np.zeros(23)
        for i, amount in amounts:
            terms[i] = amount / TERMS[i].weight
        return same(function(terms.copy(), c), combine(terms.astype(np.float32), c), 1e-5)

    step = same(function(np.eye(23)[0], 1.0), TERMS[0].weight)
    need(not step, "Multiply all weights by the control step of 0.02 s.")
    wrong = [f"T{i + 1}" for i in range(23) if not right(1.0, (i, 1.0))]
    need(not wrong, f"At c = 1 these do not count by their weights: {', '.join(wrong)}.")
    part = all(right(0.4, (i, 1.0)) for i in range(23))
    need(part, "T1 and T2 count in full, all others are multiplied by c.")
    hint = "With large penalties the sum is clipped at 0, and c times T4 is added after that."
    need(right(0.4, (0, 1.0), (3, 1.0), (5, -1000.0)), hint)
    return "The function agrees with the task, term by term."


@checker
def check_successes(answer):
    """Successes in a row that raise the curriculum coefficient from 0 to 1."""
    need(answer != 100, "The k-th success in a row adds k times as much as the first.")
    need(answer == 14, "Find the smallest n with 1 + 2 + … + n at least 100.")
    return "1 + 2 + … + 14 = 105."
