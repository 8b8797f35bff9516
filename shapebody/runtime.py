"""What a process sets up once: the compilation cache, and how the C library keeps memory."""

import hashlib
import os
import platform
import sys
from pathlib import Path

import platformdirs


def cache_folder() -> Path:
    """Where compiled programs are kept between runs.

    JAX_COMPILATION_CACHE_DIR if set; otherwise `shapebody/jax` in the user's cache folder, with one
    subfolder per processor type, because compiled CPU programs do not run on every processor.

    Raises RuntimeError where HOME is not set and the system does not know the user's home either.
    """
    chosen = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    if chosen:
        return Path(chosen).expanduser()
    folder = platformdirs.user_cache_path("shapebody", appauthor=False)
    if not folder.is_absolute():
        raise RuntimeError("the user's home folder is unknown; set HOME")
    return folder / "jax" / _processor()


def _processor() -> str:
    description = platform.machine() + platform.processor()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        description += next(line for line in lines if line.startswith(("flags", "Features")))
    except (OSError, StopIteration):
        pass
    return hashlib.sha256(description.encode()).hexdigest()[:12]


def enable_compilation_cache() -> Path | None:
    """Keep compiled programs on disk, so that a second run starts in a fraction of the time.

    Returns the folder, or None where it cannot be written (the cache then stays off). JAX's own
    JAX_ENABLE_COMPILATION_CACHE=false also switches it off. Starts no JAX backend; call it before
    the first compilation.
    """
    import jax

    try:
        folder = cache_folder()
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError, RuntimeError):  # RuntimeError: nobody knows the home folder
        return None
    if not os.access(folder, os.W_OK):
        return None
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    return folder


def keep_memory() -> bool:
    """Tell the C library to keep freed memory instead of returning it to the system.

    XLA on a CPU allocates its buffers anew in every call, and getting fresh pages each time took
    more than a third of the time of a gradient step. Linux with glibc only; elsewhere it does
    nothing. Returns whether it was done.
    """
    if not sys.platform.startswith("linux"):
        return False
    import ctypes

    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return False
    m_trim_threshold, m_top_pad, m_mmap_threshold = -1, -2, -3
    settings = ((m_mmap_threshold, 1 << 30), (m_trim_threshold, 2**31 - 1), (m_top_pad, 256 << 20))
    return all([mallopt(name, value) == 1 for name, value in settings])
