"""The choice of a physics engine by name. Each engine is imported when it is first chosen."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial
from typing import Any

import jax

from shapebody.arguments import refuse, require_engine
from shapebody.robot.robot import Robot


def resolved(engine: str) -> str:
    """ "native" or "mjx": the name itself, and for "auto" native on a CPU, MJX otherwise.

    Raises:
        ValueError: for an unknown engine.
    """
    if require_engine("engine", engine) != "auto":
        return engine
    return "native" if jax.default_backend() == "cpu" else "mjx"


def simulator(engine: str, threads: int, options: dict) -> Callable[[Robot, int], Any]:
    """A function (robot, number of environments) -> `NativePhysics` or `MjxPhysics`.

    Args:
        engine: "native" or "mjx".
        threads: of the native engine, 0 for one per CPU.
        options: further arguments of the engine's constructor, by name.

    Raises:
        ValueError: for options that the constructor does not take.
    """
    if engine == "native":
        from shapebody.physics.native import NativePhysics

        constructor = partial(NativePhysics, threads=threads)
    else:
        from shapebody.physics.mjx import MjxPhysics

        constructor = MjxPhysics
    given = ("robot", "num_envs", "threads")
    known = [name for name in inspect.signature(constructor).parameters if name not in given]
    for name in options:
        if name not in known:
            raise refuse("a key of physics_options", name, f"one of {', '.join(known)}")
    return partial(constructor, **options)
