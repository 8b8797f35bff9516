"""Versions, commit and machine: what every result and every agent says of its origin."""

from __future__ import annotations

import functools
import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path

import jax

_PACKAGES = ("shapebody", "jax", "flax", "optax", "mujoco", "numpy", "cma")

_EXTRA_PACKAGES = ("torch", "gpytorch", "botorch")  # of the extra `bo`


def provenance() -> dict:
    """Versions, commit and machine of this process, for results and agents.

    `commit` is that of the checkout which holds the package, with "+" if tracked files differ from
    it; None outside a git checkout or without git. It is read once, by the first call: long work
    makes that call before it begins, so that a later commit is not taken for the code that runs.
    """
    versions = {"python": platform.python_version()}
    for package in (*_PACKAGES, *_EXTRA_PACKAGES):
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            if package in _PACKAGES:
                versions[package] = "not installed"
    device = jax.devices()[0]
    return {
        "versions": versions,
        "commit": _commit(),
        "machine": {
            "system": platform.system(),
            "processor": platform.machine(),
            "cpus": os.cpu_count(),
            "device": device.device_kind if device.platform != "cpu" else "cpu",
        },
    }


@functools.lru_cache
def _commit() -> str | None:
    folder = Path(__file__).resolve().parent

    def git(*arguments):
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(
            command, capture_output=True, text=True, check=True, timeout=10
        ).stdout

    try:
        # An installed package may lie inside somebody else's repository.
        if Path(git("rev-parse", "--show-toplevel").strip()) != folder.parent:
            return None
        changed = git("status", "--porcelain", "--untracked-files=no", "--", str(folder)).strip()
        return git("rev-parse", "HEAD").strip() + ("+" if changed else "")
    except (OSError, subprocess.SubprocessError):
        return None
