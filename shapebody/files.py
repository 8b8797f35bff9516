"""Files of this package: where they are, locks, and writing them whole or not at all."""

from __future__ import annotations

import contextlib
import csv
import errno
import io
import os
import re
import secrets
import shutil
import signal
import threading
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import filelock
import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy

from shapebody.arguments import require_folder, require_kind, require_output, require_path
from shapebody.stored import read_metadata, read_safetensors, read_text, require_arrays


def data_dir() -> Path:
    """Folder with robots, checkpoints and results.

    `<repository>/data`, or the folder named by the environment variable `SHAPEBODY_DATA`.
    Raises FileNotFoundError if that folder does not exist.
    """
    override = os.environ.get("SHAPEBODY_DATA")
    shipped = Path(__file__).resolve().parent.parent / "data"
    folder = require_path("SHAPEBODY_DATA", override) if override else shipped
    if not folder.is_dir():
        raise FileNotFoundError(
            f"data folder {str(folder)!r} does not exist: set SHAPEBODY_DATA to the 'data' folder "
            "of a shapebody checkout, or install with 'pip install -e .' inside the checkout"
        )
    return folder


def atomic_write(path: str | Path, data: bytes | str) -> Path:
    """Write a file so that it is never seen half-written; its folder is created if needed.

    What killed calls for the same path left behind is removed. Raises OSError, which names the
    path, if the disk is full or the folder cannot be written; the old file is then as it was.
    """
    path = require_output("path", path)
    require_kind("data", data, bytes | str, "a text or bytes")
    with names_path(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_leftovers(path)
        handle, temporary = _temporary(path)
        try:
            with open(handle, "wb") as file:
                _write(file, data)
                # Before the file is closed, which ends the lock that says its writer is alive.
                os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
    return path


@contextlib.contextmanager
def names_path(path: Path):
    """Errors of the operating system in the block say what cannot be written, and of a full disk
    that it is full."""
    try:
        yield
    except OSError as error:
        if getattr(error, "told", False):  # by a block inside this one
            raise
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        fix = "make room on that disk" if full else "give another path"
        told = type(error)(f"{path} cannot be written: {error.strerror or error}; {fix}")
        told.errno, told.told = error.errno, True
        raise told from error


def _write(file, data: bytes | str) -> None:
    """Write to an open file, and have it on the disk."""
    file.write(data.encode() if isinstance(data, str) else data)
    file.flush()
    os.fsync(file.fileno())


def _temporary(path: Path) -> tuple[int, Path]:
    """A new file beside `path`, open and locked for as long as it is open."""
    while True:
        # Not the whole name, which may be as long as names can be.
        name = f".{path.name[:100]}.{secrets.token_hex(4)}.tmp"
        temporary = path.with_name(name)
        handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        _lock(handle)
        if os.fstat(handle).st_nlink:  # else taken for a leftover before it was locked
            return handle, temporary
        os.close(handle)


def _remove_leftovers(path: Path) -> None:
    """Remove temporary files for `path` whose writers are gone: nobody holds their locks."""
    form = re.compile(re.escape(f".{path.name[:100]}.") + r"[0-9a-f]{8}\.tmp")
    for name in os.listdir(path.parent):
        if form.fullmatch(name):
            with contextlib.suppress(OSError):
                handle = os.open(path.with_name(name), os.O_RDONLY | os.O_NONBLOCK)
                try:
                    if _lock(handle):
                        os.unlink(path.with_name(name))
                finally:
                    os.close(handle)


def _lock(handle: int) -> bool:
    """Lock an open file; False if somebody else has, or if that cannot be told."""
    try:
        return filelock.lock_descriptor(handle, blocking=False)
    except OSError:
        return False


@contextlib.contextmanager
def locked(path: Path, patience: float = 60.0, busy: str = ""):
    """Keep all other blocks like this for the same path waiting, in all threads and processes.

    The operating system forgets the lock when the process ends, however it ends.

    Args:
        path: what the block works on; it need not exist.
        patience: seconds to wait for another block.
        busy: the error's text, if not that of a file that is being written.

    Raises:
        ValueError: if the others have not finished after `patience` seconds.
    """
    lock = path.with_name(f".{path.name[:100]}.lock.tmp")
    holder = filelock.FileLock(lock, timeout=patience, poll_interval=0.01)
    try:
        holder.acquire()
    except filelock.Timeout:
        raise ValueError(
            busy
            or f"another process has been writing {path} for {patience:.0f} s; wait for it, or "
            "stop it"
        ) from None
    try:
        yield
    finally:
        # While it is locked: who waits for a file that is removed looks for the next one.
        with contextlib.suppress(OSError):
            lock.unlink()
        holder.release()


@contextlib.contextmanager
def alone_in(folder: str | Path):
    """Keep other processes, and other blocks like this, out of a folder while the block runs.

    Raises:
        ValueError: if the folder is taken.
    """
    folder = require_folder("folder", folder)
    busy = (
        f"another training run is at work in {folder}; wait for it, stop it, or choose another "
        "name or folder"
    )
    with locked(folder / "training", 0.0, busy):
        yield


PENDING = ".agent.new"
"""Folder with files that are on their way to their places in the folder around it."""


def replace_together(folder: Path, files: Mapping[str, bytes], removed: Iterable[str] = ()) -> None:
    """Replace files of a folder, and remove some, all at once; the folder is created if needed.

    The new files are written to a folder of their own in it. One renaming of that folder to
    `PENDING` makes them the valid ones: from then on, `current` finds them there until they are at
    their places. A process that is killed at any moment leaves all the old files or all the new.
    Raises OSError, which names the folder, if they cannot be written.
    """
    with names_path(folder), locked(folder / "agent"):
        settle(folder, alone=True)
        for leftover in folder.glob(".agent.*.tmp"):
            if leftover.is_dir():  # of a killed process, since nobody else holds the lock
                shutil.rmtree(leftover)
        stage = folder / f".agent.{secrets.token_hex(4)}.tmp"
        stage.mkdir()
        try:
            for name in removed:
                (stage / f"-{name}").touch()
            for name, data in files.items():
                with open(stage / name, "xb") as file:
                    _write(file, data)
            _synchronize(stage)
            with _uninterrupted():
                os.replace(stage, folder / PENDING)
                _synchronize(folder)
                settle(folder, alone=True)
        finally:
            shutil.rmtree(stage, ignore_errors=True)


def current(folder: Path, name: str) -> Path:
    """Where a file of that folder is now, which `replace_together` may be moving."""
    pending = folder / PENDING
    if (pending / name).exists() or (pending / f"-{name}").exists():
        return pending / name
    return folder / name


def settle(folder: Path, alone: bool = False) -> None:
    """Finish a `replace_together` that was killed; nothing where that is impossible.

    alone: the caller holds the lock, and errors are raised.
    """
    pending = folder / PENDING
    if not pending.is_dir():
        return
    if not alone:
        # Who only reads waits for nobody, and may have no right to write.
        with contextlib.suppress(OSError, ValueError), locked(folder / "agent", patience=0.0):
            settle(folder, alone=True)
        return
    for path in sorted(pending.iterdir()):
        if path.name.startswith("-"):
            (folder / path.name[1:]).unlink(missing_ok=True)
            path.unlink()
        else:
            os.replace(path, folder / path.name)
    pending.rmdir()


def _synchronize(folder: Path) -> None:
    """Have the names in a folder on the disk, as far as the file system does that."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):
            os.fsync(handle)
    finally:
        os.close(handle)


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


def curve_text(rows: Sequence[Mapping[str, Any]], columns: Sequence[str] | None = None) -> str:
    """Rows of a learning curve as CSV; columns in the order in which they occur if not given."""
    columns = columns or list(dict.fromkeys(name for row in rows for name in row))
    file = io.StringIO(newline="")
    writer = csv.DictWriter(file, columns, lineterminator="\n")
    writer.writeheader()
    for row in rows:
        plain = {k: np.asarray(v).tolist() if hasattr(v, "shape") else v for k, v in row.items()}
        writer.writerow(plain)
    return file.getvalue()


def read_curve(path: str | Path) -> dict[str, np.ndarray]:
    """Columns of a learning curve (`curve.csv` of an agent), float64, NaN where a cell is empty.

    Raises FileNotFoundError if it is missing, ValueError if it is damaged: no rows, rows of another
    length than the first, or text where a number should be.
    """
    path = require_path("path", path)
    fix = "restore it, or save the agent anew with Trainer.save_agent"
    text = read_text(path, fix)
    try:
        names, *rows = [row for row in csv.reader(io.StringIO(text)) if row] or [[]]
        if not rows:
            raise ValueError("it holds no rows; expected a header and one line per record")
        for row in rows:
            if len(row) != len(names):
                raise ValueError(f"a row of {len(row)} cells under a header of {len(names)}")
        numbers = [[float(cell) if cell else np.nan for cell in row] for row in rows]
    except (csv.Error, ValueError) as error:
        raise ValueError(f"{path} is not a learning curve ({error}); {fix}") from error
    return dict(zip(names, np.array(numbers).T, strict=True))


def save_arrays(path: str | Path, pytree) -> Path:
    """Write any pytree of arrays and numbers to one safetensors file, exactly.

    Leaves may be NumPy or JAX arrays (float, int, uint or bool) and Python numbers; None is part
    of the structure. New-style PRNG keys must be given as `jax.random.key_data(key)`.

    Raises:
        ValueError: for a leaf of another type.
    """
    arrays = dict(_leaves(pytree))
    return atomic_write(path, safetensors.numpy.save(arrays, {"crc32": _checksum(arrays)}))


def _checksum(arrays: Mapping[str, np.ndarray]) -> str:
    """A number that almost certainly changes with any name or byte."""
    value = 0
    for name in sorted(arrays):
        value = zlib.crc32(arrays[name].tobytes(), zlib.crc32(name.encode(), value))
    return f"{value:08x}"


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
    expected = dict(_leaves(like, shapes_only=True))

    def check(header):
        require_arrays(header, expected, f"{path} does not fit the state to be restored", fix)

    stored = read_safetensors(path, fix, check)
    # Files that are older than the checksum have none.
    if read_metadata(path, fix).get("crc32", _checksum(stored)) != _checksum(stored):
        raise ValueError(f"{path} is damaged: its numbers do not match its checksum; {fix}")

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
