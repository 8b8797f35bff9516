"""Settings of the locomotion task in one frozen dataclass.

Where Appendix A prints a number, it is the default. The rest (widths of noise, pushes and initial
poses, the rules of commands, the steps of the curriculum) follows the authors' earlier public
environment.
"""

from math import pi
from typing import Annotated, Literal

from pydantic import BeforeValidator

from shapebody.configuration import (
    Count,
    Flag,
    NonNegative,
    Positive,
    Probability,
    as_tuple,
    configuration,
    expecting,
    integer,
)

CONTROL_STEP = 0.02
"""Seconds per control step (50 Hz); physics runs four substeps of 5 ms inside it."""

Radius = Annotated[
    tuple[Probability, Probability],
    BeforeValidator(as_tuple),
    expecting("two numbers (low, high) with 0 <= low <= high <= 1"),
]

GAIT_PERIOD = 0.5
"""Seconds per cycle of the gait clock that the policy observes."""


@configuration
class TaskConfig:
    """The velocity-tracking task (Appendix A).

    The curriculum coefficient c in [0, 1] scales designs, initial poses, noise, pushes and all
    reward terms but T1 and T2; actions are late only at c > 0, and the height below which an
    episode ends falls with 1 - c. So at c = 0 the reference robot starts in its nominal pose,
    undisturbed, and is rewarded for tracking alone. Commands do not depend on c.
    """

    horizon: Count = 1000
    """Control steps per episode; 1,000 are 20 s."""

    command_limit: Positive | None = None
    """Largest commanded velocity in m/s (rad/s for yaw); None: min(1, 2 x mean robot dimension)."""
    command_change: Probability = 0.002
    """Probability per control step that a new command is drawn."""
    command_dead_zone: NonNegative = 0.1
    """Components below this share of the limit become zero."""
    command_all_zero: Probability = 0.04
    """Probability that a new command asks the robot to stand."""
    command_single_zero: Probability = 0.005
    """Probability that one component of a new command becomes zero."""

    noise_joint_position: NonNegative = 0.01
    """Half-width of the uniform noise on joint positions, rad."""
    noise_joint_velocity: NonNegative = 1.5
    """... on joint velocities, rad/s."""
    noise_angular_velocity: NonNegative = 0.2
    """... on the IMU's angular velocity, rad/s."""
    noise_gravity: NonNegative = 0.05
    """... on the projected gravity direction."""

    action_delay: integer(0, 1) | None = None
    """Control steps between action and effect: 0, 1, or None for a random delay per episode."""
    delay_probability: Probability = 0.5
    """With a random delay: probability that an episode's delay is one control step, not none. The
    paper says "a random action delay of up to one control step"; in the ancestors it is 0, and
    only the few episodes of `mixed_delay` have late actions, 2.5 % of all steps."""
    mixed_delay: Probability = 0.05
    """With a random delay: probability that an episode draws 0 or 1 anew in every control step."""

    initial_yaw: NonNegative = pi
    """Half-width of the initial yaw, rad."""
    initial_tilt: NonNegative = 0.05 * pi
    """Half-width of the initial roll and pitch, rad."""
    initial_joint_factor: NonNegative = 0.5
    """Initial joint positions are nominal x (1 +- this) ..."""
    initial_joint_offset: NonNegative = 0.01
    """... +- this, rad, inside the soft limits."""

    push_probability: Probability = 0.002
    """Probability per control step that the trunk is pushed."""
    push_per_mass: NonNegative = 0.1
    """Largest push in m/s (and rad/s) per kilogram of robot ..."""
    push_limit: NonNegative = 1.0
    """... and at most this."""
    push_add: Probability = 0.5
    """Probability that a push adds to the trunk velocity; otherwise it replaces it."""

    termination_height: NonNegative = 0.8
    """An episode ends when the IMU is lower than (1 - c) x this x its nominal height. The paper
    says the height of the root, the authors' earlier environment has the IMU's. A design moves the
    IMU by up to 0.1 m; of small robots some bodies have it below the floor, and at c = 1 their
    episodes end at once (0 of 1024 random bodies of the Go2, 3 of the Golem, 6.5 % of the Bittle).
    """

    design_radius: Radius = (1.0, 1.0)
    """A design is drawn from U([-rc, rc]^d), with r uniform between these two. With (0, 1), bodies
    lie at every distance from the reference; with r = 1, hardly any is near it in many dimensions.
    """
    repeat_after_fall: Probability = 0.0
    """Probability that an episode that ended in a fall is followed by one of the same design.
    Bodies on which the policy falls at once make up a small part of all steps, much smaller than
    their part of all designs; repeating them gives them more."""
    velocity_bound: Positive | None = None
    """An episode ends when a velocity of the trunk or of a joint exceeds this (m/s, rad/s), and
    the trunk's is clipped to it; None: never. 100 in the ancestors."""
    fixed_coefficient: Flag = False
    """Keep c as it was at the reset, whatever happens: for frozen policies."""
    curriculum_levels: Count = 100
    """A streak of n successful episodes raises c by n over this number."""
    curriculum_success: Literal["tracking", "return"] = "tracking"
    """What makes an episode a success, which raises c: "tracking", accurate for long enough, or
    "return", the rule of the ancestors."""
    curriculum_error: NonNegative = 0.4
    """"tracking" needs a mean velocity error per axis of at most this x the command limit ..."""
    curriculum_length: Count = 500
    """... and at least this many control steps. An episode that is cut before them without a fall
    leaves c as it is, with either rule."""
    curriculum_return: NonNegative = 8.0
    """"return" needs at least this return of the episode, however long it was (chosen by the
    ancestors for episodes of 1000 control steps)."""

    def __post_init__(self):
        low, high = self.design_radius
        if low > high:
            raise ValueError(
                f"design_radius is {self.design_radius}; expected (low, high) with low <= high"
            )

    @classmethod
    def ancestors(cls, **changes) -> "TaskConfig":
        """Settings of the authors' public environment at the time of the paper, where ours differ:
        actions are rarely late, an episode succeeds by its return, and velocities above 100 end
        it. The paper states none of them; `full` uses them, since it takes up what matches it."""
        named = dict(delay_probability=0.0, curriculum_success="return", velocity_bound=100.0)
        return cls(**{**named, **changes})

    @classmethod
    def evaluation(cls, **changes) -> "TaskConfig":
        """Settings for evaluation: commands within +-1 for every design and an action delay of
        exactly one control step. The paper does not state them all; with these, the authors'
        published policies gain about what the paper reports for two of three robots (notebook
        03)."""
        return cls(**{"command_limit": 1.0, "action_delay": 1, **changes})
