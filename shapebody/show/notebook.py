"""The first cell of a notebook."""

import os
import platform
import sys

import jax
import mujoco

import shapebody
from shapebody.runtime import enable_compilation_cache
from shapebody.show import opengl, plots


def start_notebook() -> None:
    """Set up a notebook and print one line with the versions its results were made with.

    Compilation cache, house style of figures, off-screen OpenGL (MUJOCO_GL is set where nothing
    else is and there is no display), and no preallocation of GPU memory, so that two notebooks can
    share one GPU. Every step respects settings made before.
    """
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    enable_compilation_cache()
    interface = opengl.find_opengl()
    if sys.platform == "linux" and interface in ("egl", "osmesa"):
        os.environ.setdefault("MUJOCO_GL", interface)
    plots.use_style()
    device = jax.devices()[0]
    where = "the CPU" if device.platform == "cpu" else device.device_kind
    print(
        f"shapebody {shapebody.__version__}, Python {platform.python_version()}, "
        f"jax {jax.__version__} on {where}, mujoco {mujoco.__version__}, "
        f"pictures through {interface or 'drawing'}"
    )
