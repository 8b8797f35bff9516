"""The performance-based curriculum coefficient c (Appendix A, "Curriculum and design sampling").

The paper refers to earlier work for the rule; this is the rule of the authors' public environment.
What counts as a success changed there: it was the return of the episode at the time of the paper
(`TaskConfig.ancestors`), and is the accuracy of tracking since.

c is how hard an episode is; `TaskConfig` says what it scales. Each environment has its own. A
streak of successful episodes raises it faster and faster, a streak of failures lowers it likewise,
by streak / `curriculum_levels`. Added here: an episode that is cut before `curriculum_length`
without a fall is neither, as are many of a batch's first ones, whose horizons are staggered.
"""

import jax.numpy as jnp

from shapebody.task.config import TaskConfig


def is_conclusive(config: TaskConfig, length, terminated):
    """Whether an episode counts: it fell, or lasted long enough for a success.

    length: control steps; terminated: whether it ended before its horizon (a fall, too high a
    velocity, or failed physics).
    """
    return terminated | (length >= config.curriculum_length)


def is_success(config: TaskConfig, mean_error, length, command_limit, episode_return):
    """Whether an episode counts as a success.

    mean_error: mean over time and axes of |v_xy - c_xy|, m/s, each term at most twice the command
    limit; length: control steps; command_limit: m/s; episode_return: undiscounted.
    """
    if config.curriculum_success == "return":
        return episode_return >= config.curriculum_return
    accurate = mean_error <= config.curriculum_error * command_limit
    return accurate & (length >= config.curriculum_length)


def update(config: TaskConfig, coefficient, streak, success):
    """New (coefficient in [0, 1], streak) after an episode. `streak` counts successes in a
    row as positive and failures in a row as negative numbers."""
    streak = jnp.where(
        success, jnp.where(streak >= 0, streak + 1, 1), jnp.where(streak < 0, streak - 1, -1)
    )
    change = streak.astype(jnp.float32) / config.curriculum_levels
    return jnp.clip(coefficient + change, 0.0, 1.0), streak
