"""Settings of the locomotion task in one frozen dataclass.

Where Appendix A prints a number, it is the default. The rest (widths of noise, pushes and initial
poses, the rules of commands, the steps of the curriculum) follows the authors' earlier public
environment.
"""

from dataclasses import dataclass
from math import inf, nan, pi
from numbers import Integral, Real

from shapebody.arguments import require_choice, require_flag, shown

CONTROL_STEP = 0.02
"""Seconds per control step (50 Hz); physics runs four substeps of 5 ms inside it."""

GAIT_PERIOD = 0.5
"""Seconds per cycle of the gait clock that the policy observes."""

_RANGES = {
    "an integer of at least 1": (Integral, 1, inf, "horizon curriculum_levels curriculum_length"),
    "a probability, from 0 to 1": (
        Real,
        0,
        1,
        "command_change command_all_zero command_single_zero delay_probability mixed_delay "
        "push_probability push_add",
    ),
    "a finite number of at least 0": (
        Real,
        0,
        inf,
        "command_dead_zone noise_joint_position noise_joint_velocity noise_angular_velocity "
        "noise_gravity initial_yaw initial_tilt initial_joint_factor initial_joint_offset "
        "push_per_mass push_limit termination_height curriculum_error curriculum_return",
    ),
}
"""What settings must be: in words, then their kind, their bounds and their names."""


@dataclass(frozen=True)
class TaskConfig:
    """The velocity-tracking task (Appendix A).

    The curriculum coefficient c in [0, 1] scales designs, initial poses, noise and pushes, and
    the delay acts only at c > 0: at c = 0 the reference robot starts in its nominal pose and
    feels none of them. Commands do not depend on c.
    """

    horizon: int = 1000
    """Control steps per episode (20 s)."""

    command_limit: float | None = None
    """Largest commanded velocity in m/s (rad/s for yaw); None: min(1, 2 x mean robot dimension)."""
    command_change: float = 0.002
    """Probability per control step that a new command is drawn."""
    command_dead_zone: float = 0.1
    """Components below this share of the limit become zero."""
    command_all_zero: float = 0.04
    """Probability that a new command asks the robot to stand."""
    command_single_zero: float = 0.005
    """Probability that one component of a new command becomes zero."""

    noise_joint_position: float = 0.01
    """Half-width of the uniform noise on joint positions, rad."""
    noise_joint_velocity: float = 1.5
    """... on joint velocities, rad/s."""
    noise_angular_velocity: float = 0.2
    """... on the IMU's angular velocity, rad/s."""
    noise_gravity: float = 0.05
    """... on the projected gravity direction."""

    action_delay: int | None = None
    """Control steps between action and effect: 0, 1, or None for a random delay per episode."""
    delay_probability: float = 0.5
    """With a random delay: probability that an episode's delay is one control step, not none. The
    paper says "a random action delay of up to one control step"; in the ancestors it is 0, and
    only the few episodes of `mixed_delay` have late actions, 2.5 % of all steps."""
    mixed_delay: float = 0.05
    """With a random delay: probability that an episode draws 0 or 1 anew in every control step."""

    initial_yaw: float = pi
    """Half-width of the initial yaw, rad."""
    initial_tilt: float = 0.05 * pi
    """Half-width of the initial roll and pitch, rad."""
    initial_joint_factor: float = 0.5
    """Initial joint positions are nominal x (1 +- this) ..."""
    initial_joint_offset: float = 0.01
    """... +- this, rad, inside the soft limits."""

    push_probability: float = 0.002
    """Probability per control step that the trunk is pushed."""
    push_per_mass: float = 0.1
    """Largest push in m/s (and rad/s) per kilogram of robot ..."""
    push_limit: float = 1.0
    """... and at most this."""
    push_add: float = 0.5
    """Probability that a push adds to the trunk velocity; otherwise it replaces it."""

    termination_height: float = 0.8
    """An episode ends when the IMU is lower than (1 - c) x this x its nominal height. The paper
    says the height of the root, the authors' earlier environment has the IMU's. A design moves the
    IMU by up to 0.1 m; of small robots some bodies have it below the floor, and at c = 1 their
    episodes end at once (0 of 1024 random bodies of the Go2, 3 of the Golem, 6.5 % of the Bittle).
    """

    design_radius: tuple[float, float] = (1.0, 1.0)
    """A design is drawn from U([-rc, rc]^d), with r uniform between these two. With (0, 1), bodies
    lie at every distance from the reference; with r = 1, hardly any is near it in many dimensions.
    """
    velocity_bound: float | None = None
    """An episode ends when a velocity of the trunk or of a joint exceeds this (m/s, rad/s), and
    the trunk's is clipped to it; None: never. 100 in the ancestors."""
    fixed_coefficient: bool = False
    """Keep c as it was at the reset, whatever happens: for frozen policies."""
    curriculum_levels: int = 100
    """A streak of n successful episodes raises c by n over this number."""
    curriculum_success: str = "tracking"
    """What makes an episode a success, which raises c: "tracking", accurate for long enough, or
    "return", the rule of the ancestors."""
    curriculum_error: float = 0.4
    """"tracking" needs a mean velocity error per axis of at most this x the command limit ..."""
    curriculum_length: int = 500
    """... and at least this many control steps. An episode that is cut before them without a fall
    leaves c as it is, with either rule."""
    curriculum_return: float = 8.0
    """"return" needs at least this return of the episode, however long it was (chosen by the
    ancestors for episodes of 1000 control steps)."""

    def __post_init__(self):
        delay = self.action_delay
        if delay is not None and not _is_number(delay, Integral, 0, 1):
            raise ValueError(
                f"action_delay is {shown(delay)}; expected 0, 1 or None (random per episode)"
            )
        try:
            low, high = (float(r) for r in self.design_radius)
        except (TypeError, ValueError):
            low, high = nan, nan
        if not 0 <= low <= high <= 1:
            raise ValueError(
                f"design_radius is {shown(self.design_radius)}; expected two numbers (low, high) "
                "with 0 <= low <= high <= 1"
            )
        object.__setattr__(self, "design_radius", (low, high))
        limit = self.command_limit
        if limit is not None and not (_is_number(limit, Real, 0, inf) and limit > 0):
            raise ValueError(
                f"command_limit is {shown(limit)}; expected a positive number, in m/s, or None (it "
                "follows from the robot's dimensions)"
            )
        bound = self.velocity_bound
        if bound is not None and not (_is_number(bound, Real, 0, inf) and bound > 0):
            raise ValueError(
                f"velocity_bound is {shown(bound)}; expected a positive number, in m/s and rad/s, "
                "or None (no bound)"
            )
        require_flag("fixed_coefficient", self.fixed_coefficient)
        require_choice("curriculum_success", self.curriculum_success, ("tracking", "return"))
        for expected, (kind, low, high, names) in _RANGES.items():
            for name in names.split():
                value = getattr(self, name)
                if not _is_number(value, kind, low, high):
                    raise ValueError(f"{name} is {shown(value)}; expected {expected}")

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
        02)."""
        return cls(**{"command_limit": 1.0, "action_delay": 1, **changes})


def _is_number(value, kind, low, high) -> bool:
    """Whether a value is a finite number of that kind from `low` to `high`; True is none."""
    number = isinstance(value, kind) and not isinstance(value, bool)
    return number and low <= value <= high and value < inf
