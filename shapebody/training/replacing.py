"""Whether the agent in a folder may be replaced by what is trained there."""

from pathlib import Path

from shapebody.agent.description import read_metadata


def metadata_in(folder: Path) -> dict | None:
    """Metadata of the agent in a folder: None if there is no agent, {} if they are unreadable."""
    try:
        return read_metadata(folder)
    except (ValueError, OSError):
        return {}


def steps_in(folder: Path) -> int | None:
    """Steps of the agent in a folder: None if there is no agent, 0 if it does not say."""
    metadata = metadata_in(folder)
    return None if metadata is None else metadata.get("steps", 0)


def require_replaceable(folder: Path, steps: int, others: str = "") -> None:
    """Refuse to replace the agent in a folder by a lesser one.

    Args:
        folder: of the agent.
        steps: environment steps of the one that would replace it.
        others: ways out that the error names beside replace=True.

    Raises:
        ValueError: if the agent has more steps, or a critic from policy evaluation.
    """
    kept = steps_in(folder)
    # A run that is about to begin replaces no agent, not even one of unknown steps.
    if kept is not None and (kept > steps or steps == 0):
        raise ValueError(
            f"the agent in {folder} has {kept:,} steps, the run that would replace it {steps:,}; "
            f"pass replace=True (--replace) to replace it{others}"
        )
    if "policy_evaluation" in (metadata_in(folder) or {}):
        raise ValueError(
            f"the agent in {folder} has a critic from policy evaluation, which the run that would "
            "replace the agent does not have; pass replace=True (--replace) to replace it, and "
            f"repeat the policy evaluation afterwards{others}"
        )
