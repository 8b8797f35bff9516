"""Reading what was stored: files may be cut off, edited, of another version or made to do harm.

Every function here raises FileNotFoundError for a missing file and ValueError for any other fault.
The message names the file and ends with `fix`, the caller's way out. What a file says of its own
size is compared with what is expected, and with the size of the file, before anything is expanded.
"""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy

from shapebody.arguments import shown

TEXT_LIMIT = 2**26
"""Bytes of the largest text file that is read, 64 MiB; shipped ones have less than one."""
HEADER_LIMIT = 2**24
"""Bytes of the largest header of a safetensors file; that of the paper's networks has 20,000."""
ARRAYS_LIMIT = 2**28
"""Bytes of the largest state bank, expanded: 256 MiB. Shipped ones have less than one."""
DEPTH_LIMIT = 64
"""Lists and objects inside each other in a JSON file."""


# ---------------------------------------------------------------------- texts


def read_text(path: Path, fix: str) -> str:
    """A UTF-8 text of at most `TEXT_LIMIT` bytes."""
    require_regular_file(path, fix)
    size = path.stat().st_size
    if size > TEXT_LIMIT:
        raise ValueError(f"{path} has {size:,} bytes, more than {TEXT_LIMIT:,}; {fix}")
    try:
        return path.read_bytes().decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is damaged: it is not UTF-8 text ({error}); {fix}") from error


def require_regular_file(path: Path, fix: str) -> None:
    """FileNotFoundError if there is nothing, ValueError for a folder, pipe or device."""
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; {fix}")
    if not path.is_file():
        raise ValueError(f"{path} is not a regular file; {fix}")


def read_json(path: Path, fix: str, finite: bool = True) -> Any:
    """What a JSON file holds; lists and objects at most `DEPTH_LIMIT` deep.

    finite: refuse NaN and infinite numbers.
    """
    text = read_text(path, fix)
    try:
        strict = dict(parse_constant=_refuse, parse_float=_finite) if finite else {}
        value = json.loads(text, **strict)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is damaged: it is not valid JSON ({error}); {fix}") from error
    if _depth(value) > DEPTH_LIMIT:
        raise ValueError(
            f"{path} is damaged: more than {DEPTH_LIMIT} lists and objects inside each other; {fix}"
        )
    return value


def _refuse(constant: str):
    raise ValueError(f"{constant} is not a JSON number")


def _finite(text: str) -> float:
    value = float(text)
    return value if math.isfinite(value) else _refuse(text)


def _depth(value) -> int:
    """How deep lists and dictionaries lie inside each other, without recursion."""
    depth, level = 0, [value]
    while level := [x for x in level if isinstance(x, dict | list)]:
        depth += 1
        level = [y for x in level for y in (x.values() if isinstance(x, dict) else x)]
    return depth


# ---------------------------------------------------------------------- arrays


Header = Mapping[str, tuple[tuple[int, ...], np.dtype]]
"""Shapes and types of arrays by name."""

_DTYPES = {
    {"f": "F", "i": "I", "u": "U"}[x[0]] + str(8 * int(x[1:])): np.dtype(x)
    for x in "f2 f4 f8 i1 i2 i4 i8 u1 u2 u4 u8".split()
} | {"BOOL": np.dtype(bool)}


def require_arrays(found: Header, expected: Header, what: str, fix: str) -> None:
    """ValueError if arrays have other names, shapes or types than expected.

    what: begins the message, such as "x.safetensors does not fit its configuration".
    """
    problems = [f"{name} is missing" for name in expected if name not in found]
    problems += [f"{shown(name)} is unknown" for name in found if name not in expected]
    for name, (shape, dtype) in expected.items():
        if name in found and found[name] != (shape, dtype):
            own_shape, own = found[name]
            problems.append(f"{name} is {own}{list(own_shape)}, expected {dtype}{list(shape)}")
    if problems:
        more = f" and {len(problems) - 3} more" if len(problems) > 3 else ""
        raise ValueError(f"{what}: {'; '.join(problems[:3])}{more}; {fix}")


def read_safetensors(
    path: Path, fix: str, check: Callable[[Header], None] | None = None
) -> dict[str, np.ndarray]:
    """Arrays of a safetensors file by name.

    check: called with shapes and types before the arrays are read; raises for unexpected ones.
    """
    header, _, _ = _safetensors_header(path, fix)
    if check:
        check(header)
    try:
        return safetensors.numpy.load(path.read_bytes())
    except Exception as error:  # the reader has many kinds
        raise ValueError(f"{path} is cut off or not a safetensors file ({error}); {fix}") from error


def read_number(path: Path, name: str, fix: str) -> int:
    """One integer, an array of shape [], of a safetensors file; the rest is not read."""
    header, places, metadata = _safetensors_header(path, fix)
    shape, dtype = header.get(name, (None, None))
    if shape != () or dtype.kind not in "iu":
        raise ValueError(f"{path} has no integer {name!r}; {fix}")
    with open(path, "rb") as file:
        file.seek(places[name])
        return int(np.frombuffer(file.read(dtype.itemsize), dtype)[0])


def read_metadata(path: Path, fix: str) -> dict[str, str]:
    """The texts that a safetensors file holds beside its arrays."""
    return _safetensors_header(path, fix)[2]


def _safetensors_header(path: Path, fix: str):
    """(shapes and types, places in the file, metadata); the arrays fill the rest of the file."""
    require_regular_file(path, fix)
    try:
        size = path.stat().st_size
        with open(path, "rb") as file:
            length = int.from_bytes(file.read(8), "little")
            if not 2 <= length <= min(size - 8, HEADER_LIMIT):
                raise ValueError(f"a header of {length:,} bytes in a file of {size:,}")
            document = json.loads(file.read(length))
        metadata = document.pop("__metadata__", {})
        header, places, end = {}, {}, 8 + length
        by_place = sorted(document.items(), key=lambda item: item[1]["data_offsets"])
        for name, entry in by_place:
            shape, dtype = tuple(entry["shape"]), _DTYPES[entry["dtype"]]
            if not all(type(x) is int and x >= 0 for x in shape):
                raise ValueError(f"{name} has shape {shown(shape)}")
            header[name], places[name] = (shape, dtype), end
            end += math.prod(shape) * dtype.itemsize
            if entry["data_offsets"] != [places[name] - 8 - length, end - 8 - length]:
                raise ValueError(f"{name} is not as long as its shape says")
        if end != size:
            raise ValueError(f"{size:,} bytes, expected {end:,}")
        if not isinstance(metadata, dict):
            raise ValueError("__metadata__ is not an object")
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(
            f"{path} is cut off or not a safetensors file ({type(error).__name__}: {error}); {fix}"
        ) from error
    return header, places, metadata


_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
# Of these alone, Python's zipfile expands no more at a time than is asked for.


def read_npz(path: Path, expected: Header, fix: str) -> dict[str, np.ndarray]:
    """Arrays of an .npz file, all of one length M and together of at most `ARRAYS_LIMIT` bytes.

    expected: by name, shape after the first axis, and type.
    """
    require_regular_file(path, fix)
    arrays = {}
    try:
        with zipfile.ZipFile(path) as archive:
            entries = {x.filename.removesuffix(".npy"): x for x in archive.infolist()}
            problems = _problems_of_entries(entries, archive, expected)
            for name in () if problems else expected:
                rest, kind = expected[name][0], np.dtype(expected[name][1])
                with archive.open(entries[name]) as file:
                    shape, dtype, start = _npy_header(file)
                    if shape[1:] != rest or (dtype, len(shape)) != (kind, len(rest) + 1):
                        wanted = ", ".join(map(str, ("M", *rest)))
                        problems.append(
                            f"{path.stem}.{name} is {dtype}{list(shape)}, expected {kind}[{wanted}]"
                        )
                        continue
                    size = math.prod(shape) * kind.itemsize
                    if entries[name].file_size != start + size:
                        raise ValueError(f"{name} is not as long as its shape says")
                    arrays[name] = np.frombuffer(file.read(size + 1), kind).reshape(shape).copy()
    except Exception as error:  # zipfile, zlib, NumPy's header: each has many kinds
        text = f"{type(error).__name__}: {error}"
        raise ValueError(f"{path} is cut off or not a state bank ({text}); {fix}") from error
    lengths = sorted({len(array) for array in arrays.values()})
    if len(lengths) > 1:
        problems.append(f"its arrays have the different lengths {lengths}")
    if problems:
        raise ValueError(f"{path} is not as expected: {'; '.join(problems[:3])}; {fix}")
    return arrays


def _problems_of_entries(entries, archive, expected: Header) -> list[str]:
    """What is wrong with the names and sizes in an archive, before anything is expanded."""
    if len(entries) < len(archive.infolist()):
        raise ValueError("an array is there twice")
    if any(entry.compress_type not in _COMPRESSIONS for entry in entries.values()):
        raise ValueError("a compression that np.savez does not use")
    problems = [f"{name} is missing" for name in expected if name not in entries]
    problems += [f"{shown(name)} is unknown" for name in entries if name not in expected]
    total = sum(entry.file_size for entry in entries.values())
    if total > ARRAYS_LIMIT:
        problems.append(f"it expands to {total:,} bytes, at most {ARRAYS_LIMIT:,} can be")
    return problems


def _npy_header(file) -> tuple[tuple[int, ...], np.dtype, int]:
    """(shape, type, length of the header) of an array in an .npz file."""
    version = np.lib.format.read_magic(file)
    read = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    shape, fortran, dtype = read[version](file, max_header_size=4096)
    if fortran or not all(type(x) is int and x >= 0 for x in shape):
        raise ValueError(f"an array of shape {shape}, in Fortran's order: {fortran}")
    return shape, dtype, file.tell()
