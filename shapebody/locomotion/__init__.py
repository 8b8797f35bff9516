"""The velocity-tracking locomotion task (Appendix A), written once for both engines."""

from shapebody.locomotion.config import CONTROL_STEP, TaskConfig
from shapebody.locomotion.env import Locomotion, Trajectory
from shapebody.locomotion.episode import Episode, Outcome
from shapebody.locomotion.observations import Observation
from shapebody.locomotion.rewards import TERMS

__all__ = [
    "CONTROL_STEP",
    "TERMS",
    "Episode",
    "Locomotion",
    "Observation",
    "Outcome",
    "TaskConfig",
    "Trajectory",
]
