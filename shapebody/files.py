"""Files that are never half-written, and exact copies of training state. No pickle."""

from __future__ import annotations

import contextlib
import csv
import fcntl
import os
import secrets
import signal
import threading
from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy

from shapebody.checks import (
    names_the_file,
    require_file,
    require_folder,
    require_kind,
    require_output,
    require_path,
)


@names_the_file
def atomic_write(path: str | Path, data: bytes | str) -> Path:
    """Write a file so that it is never seen half-written; its folder is created if needed."""
    path = require_output("path", path)
    require_kind("data", data, bytes | str, "a text or bytes")
    atomic_write_all({path: data})
    return path


@names_the_file
def atomic_write_all(files: Mapping[Path, bytes | str]) -> None:
    """Write files that belong together; their folders are created if needed.

    All are written under temporary names first. Then they take their places at once, in the given
    order. An interruption before that leaves all the old files; Ctrl-C during it waits.
    """
    require_kind("files", files, Mapping, "what to write, by path")
    files = {require_path("a path in files", path): data for path, data in files.items()}
    temporaries = {}
    try:
        for path, data in files.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
            temporaries[temporary] = path
            with open(temporary, "xb") as file:
                file.write(data.encode() if isinstance(data, str) else data)
                file.flush()
                os.fsync(file.fileno())
        with _uninterrupted():
            for temporary, path in temporaries.items():
                os.replace(temporary, path)
    finally:
        for temporary in temporaries:
            temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def _uninterrupted():
    """Ctrl-C is held back until the end of the block (Python delivers it to the main thread)."""
    held = []
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, lambda *_: held.append(True))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL if before is None else before)
    if held:
        signal.raise_signal(signal.SIGINT)


@contextlib.contextmanager
def alone_in(folder: str | Path):
    """Keep other processes, and other blocks like this, out of a folder while the block runs.

    The operating system forgets the lock when the process ends, however it ends.

    Raises:
        ValueError: if the folder is taken.
    """
    handle = os.open(require_folder("folder", folder), os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ValueError(
                f"another training run is at work in {folder}; wait for it, stop it, or choose "
                "another name or folder"
            ) from error
        yield
    finally:
        os.close(handle)


def read_curve(path: str | Path) -> dict[str, np.ndarray]:
    """Columns of a learning curve (`curve.csv` of an agent), float64, NaN where a cell is empty.

    Raises ValueError if it holds no rows, or text where a number should be.
    """
    with open(require_file("path", path), newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    if not rows:
        raise ValueError(f"{path} holds no rows; expected a header and one line per record")
    try:
        return {
            name: np.array([float(row[name]) if row[name] else np.nan for row in rows])
            for name in rows[0]
        }
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path} is no learning curve ({error})") from error


def read_safetensors(path: Path, fix: str) -> dict[str, np.ndarray]:
    """Arrays of a safetensors file by name; errors end with `fix`."""
    path = require_path("path", path)
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist; {fix}")
    try:
        return safetensors.numpy.load(path.read_bytes())
    except (safetensors.SafetensorError, KeyError, ValueError) as error:
        raise ValueError(f"{path} is cut off or no safetensors file ({error}); {fix}") from error


def save_arrays(path: str | Path, pytree) -> Path:
    """Write any pytree of arrays and numbers to one safetensors file, exactly.

    Leaves may be NumPy or JAX arrays (float, int, uint or bool) and Python numbers; None is part
    of the structure. New-style PRNG keys must be given as `jax.random.key_data(key)`.

    Raises:
        ValueError: for a leaf of another type.
    """
    return atomic_write(path, safetensors.numpy.save(dict(_leaves(pytree))))


def load_arrays(path: str | Path, like):
    """Read a file of `save_arrays` into the structure of `like`.

    Leaves come back as what `like` holds: NumPy arrays, JAX arrays or Python numbers (NumPy arrays
    for `jax.ShapeDtypeStruct`), with the same bits as they were saved with.

    Raises:
        FileNotFoundError: for a missing file.
        ValueError: if the file is cut off, or its names, shapes or types differ from those of
            `like`.
    """
    path = require_path("path", path)
    fix = "delete it to start anew, or use the configuration it was written with"
    stored = read_safetensors(path, fix)
    expected = dict(_leaves(like, shapes_only=True))
    problems = [f"{name} is missing" for name in expected if name not in stored]
    problems += [f"{name} is unknown" for name in stored if name not in expected]
    for name, (shape, dtype) in expected.items():
        if name in stored and (stored[name].shape, stored[name].dtype) != (shape, dtype):
            problems.append(
                f"{name} is {stored[name].dtype}{list(stored[name].shape)}, expected "
                f"{dtype}{list(shape)}"
            )
    if problems:
        more = f" and {len(problems) - 3} more" if len(problems) > 3 else ""
        raise ValueError(
            f"{path} does not fit the state to be restored: {'; '.join(problems[:3])}{more}; {fix}"
        )

    def restored(place, leaf):
        value = stored[_leaf_name(place)]
        if isinstance(leaf, jax.Array):
            return jnp.array(value)
        if isinstance(leaf, bool | int | float):
            return value.item()
        return value

    return jax.tree_util.tree_map_with_path(restored, like)


def _leaf_name(place) -> str:
    return jax.tree_util.keystr(place, simple=True, separator="/") or "value"


def _leaves(pytree, shapes_only=False):
    """Names and arrays, or names and (shape, dtype), of the leaves of a pytree."""
    for place, leaf in jax.tree_util.tree_leaves_with_path(pytree):
        name = _leaf_name(place)
        if shapes_only and hasattr(leaf, "dtype") and hasattr(leaf, "shape"):
            yield name, (tuple(leaf.shape), np.dtype(leaf.dtype))
            continue
        # Copies: the leaf may be a live buffer or not contiguous.
        array = None
        if not (hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)):
            array = np.array(leaf, order="C")
        if array is None or array.dtype.kind not in "fiub":
            raise ValueError(
                f"leaf {name!r} is {getattr(leaf, 'dtype', type(leaf).__name__)}; expected an "
                "array of float, int, uint or bool (for PRNG keys use jax.random.key_data)"
            )
        yield name, (array.shape, array.dtype) if shapes_only else array
