"""Finding a way to draw with OpenGL without a display."""

import functools
import os
import subprocess
import sys

_PROBE = """
import importlib, mujoco
context = importlib.import_module("mujoco.{name}").GLContext(16, 16)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), 150).free()
context.free()
print("works")
"""

NO_OPENGL = (
    "No OpenGL found, so robots are drawn instead of rendered. To install it: "
    "'apt-get install libegl1 libgl1-mesa-dri' (Debian, Ubuntu), "
    "'dnf install mesa-libEGL mesa-dri-drivers' (Fedora) or "
    "\"conda install -c conda-forge 'mesalib<25.1'\"; then restart the kernel."
)


@functools.cache
def find_opengl() -> str | None:
    """Name of the OpenGL interface that works here ("egl", "osmesa", "glfw", "cgl"), or None.

    Honours MUJOCO_GL ("off" forbids OpenGL). Each candidate is tried once in a process of its own,
    because a broken driver can end the process and a failed attempt cannot be taken back.
    """
    for name in _candidates():
        environment = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"}
        environment["MUJOCO_GL"] = name
        try:
            probe = subprocess.run(
                [sys.executable, "-c", _PROBE.format(name=name)],
                env=environment,
                capture_output=True,
                text=True,
                timeout=60,
            )
        except (OSError, subprocess.TimeoutExpired):
            continue
        if "works" in probe.stdout:
            return name
    return None


def _candidates() -> list[str]:
    wish = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wish in ("disable", "disabled", "off", "false", "0"):
        return []
    if wish in ("egl", "osmesa", "glfw", "cgl"):
        return [wish]
    if sys.platform == "darwin":
        return ["cgl", "glfw"]
    if sys.platform != "linux":
        return ["glfw"]
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return ["egl", "osmesa"] + (["glfw"] if display else [])


@functools.cache
def say_once(message: str) -> None:
    """Print a message, but only the first time."""
    print(message)
