"""Checks of arguments that all modules share.

Each takes the name of the argument and its value, returns the value in the form that is worked
with, and raises an error that says what was given, what was expected and, with `hint`, where to get
it: TypeError for an object of another class (`require_kind`), ValueError otherwise. They are called
where a value enters the package, before anything expensive, and never inside compiled code.
"""

import math
import numbers
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np

LONGEST_SHOWN = 80
"""Characters of a value in an error message."""
LARGEST = 2**31 - 1
"""Largest integer where no other bound is given: what is counted is kept in 32 bits."""
SEEDS = 2**32
"""Seeds are below this: JAX keeps 32 bits of a seed, so that larger ones would repeat."""
LONGEST_PART = 255
"""Bytes of a file's or folder's name, on all usual file systems."""
LONGEST_PATH = 4095
"""Bytes of a path, on Linux."""


def shown(value) -> str:
    """A value on one line for an error message, shortened if it is long; an array by its shape."""
    if _is_array(value) and np.ndim(value):
        return f"an array {value.dtype}{list(value.shape)}"
    if isinstance(value, dict | list | tuple | set) and len(value) > 1000:
        return f"a {type(value).__name__} of {len(value):,} entries"  # its repr would take long
    try:
        text = " ".join(repr(value[:1000] if isinstance(value, str | bytes) else value).split())
    except Exception:  # an object that cannot even be printed
        return f"an object of class {type(value).__name__}"
    if len(text) <= LONGEST_SHOWN:
        return text
    length = f" ({len(value):,} characters)" if isinstance(value, str) else ""
    return f"{text[: LONGEST_SHOWN - 3]}...{length}"


def _is_array(value) -> bool:
    return hasattr(value, "dtype") and hasattr(value, "shape")


def refuse(name: str, value, expected: str, hint: str = "", kind: type = ValueError):
    """The error to be raised for a value: what it is, what was expected, how to come by that."""
    return kind(f"{name} is {shown(value)}; expected {expected}{f': {hint}' if hint else ''}")


def require_kind(name: str, value, kind, hint: str):
    """The value; TypeError if it is no instance of `kind`, a class or classes joined with "|".
    `hint` says how to come by one."""
    if not isinstance(value, kind):
        label = getattr(kind, "__name__", str(kind))
        article = "an" if label[0] in "AEIOU" else "a"
        raise refuse(name, value, f"{article} {label}", hint, TypeError)
    return value


# ------------------------------------------------------------------ numbers


def require_integer(name: str, value, least: int = 0, most: int = LARGEST) -> int:
    """The value as an int; ValueError if it is no integer from `least` to `most`."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral) or value < least:
        raise refuse(name, value, f"an integer of at least {least}")
    if value > most:
        raise refuse(name, value, f"an integer from {least} to {most:,}")
    return int(value)


def require_seed(name: str, value) -> int:
    """The value as an int; ValueError if it is no integer from 0 to 2**32 - 1."""
    return require_integer(name, value, 0, SEEDS - 1)


def require_number(
    name: str,
    value,
    least: float = -math.inf,
    most: float = math.inf,
    *,
    above: float | None = None,
    hint: str = "",
) -> float:
    """The value as a float; ValueError if it is no finite number from `least` to `most`.

    With `above`, it also has to be larger than that.
    """
    right = isinstance(value, numbers.Real) and not isinstance(value, bool)
    try:
        number = float(value) if right else math.nan
    except OverflowError:  # an int beyond the largest float
        number = math.inf
    inside = least <= number <= most and (above is None or number > above)
    if not (math.isfinite(number) and inside):
        raise refuse(name, value, _range(least, most, above), hint)
    return number


def _range(least, most, above) -> str:
    """A range of numbers in words."""
    low = "" if least == -math.inf else f"{least:g}"
    if above is not None:
        if most < math.inf:
            return f"a number above {above:g} and at most {most:g}"
        return "a positive number" if above == 0 else f"a finite number above {above:g}"
    if most < math.inf and low:
        return f"a number from {low} to {most:g}"
    if most < math.inf:
        return f"a finite number of at most {most:g}"
    return f"a finite number of at least {low}" if low else "a finite number"


def require_flag(name: str, value) -> bool:
    """The value as a bool; ValueError if it is neither True nor False."""
    if not isinstance(value, bool | np.bool_):
        raise refuse(name, value, "True or False")
    return bool(value)


def require_choice(name: str, value, choices: Iterable):
    """The value; ValueError if it is none of `choices` (texts)."""
    choices = tuple(choices)
    if not isinstance(value, str) or value not in choices:
        raise refuse(name, value, f"one of {', '.join(choices)}")
    return value


def require_engine(name: str, value) -> str:
    """The value; ValueError if it is not the name of a physics engine."""
    return require_choice(name, value, ("auto", "native", "mjx"))


# ------------------------------------------------------------------ arrays


def require_array(name: str, value, shape=None, *, kinds: str = "fiub", finite: bool = True):
    """The value as a NumPy array; ValueError for another shape, or what is no array of numbers.

    Args:
        name, value: the argument.
        shape: the expected shape: an int for a fixed length, a text for the name of a free one,
            "..." first for any leading axes; None for any shape.
        kinds: letters of NumPy's kinds of numbers that are allowed: "iu" for integers.
        finite: refuse NaN and infinity.
    """
    wanted = {"iu": "integers", "b": "True and False"}.get(kinds, "numbers")
    expected = f"an array of {wanted}{'' if shape is None else f' {shape_text(shape)}'}"
    try:
        array = np.asarray(value)
    except Exception as error:  # ragged lists, and arrays of libraries that do not hand them over
        raise refuse(name, value, expected) from error
    if array.size == 0 and not _is_array(value):
        array = array.astype({"iu": int, "b": bool}.get(kinds, float))
    # "V" is what NumPy makes of JAX's bfloat16.
    if array.dtype.kind not in kinds and not (array.dtype.kind == "V" and "f" in kinds):
        raise refuse(name, value, expected)
    require_shape(name, array, shape)
    if finite and array.dtype.kind == "f" and not np.isfinite(array).all():
        where = np.argwhere(~np.isfinite(array))[0].tolist()
        raise ValueError(
            f"{name} is {array[tuple(where)]} at entry {where}; expected finite numbers: remove or "
            "replace the others"
        )
    return array


def single(array):
    """A NumPy array as float32; a number beyond its range becomes infinite without a warning."""
    with np.errstate(over="ignore"):
        return np.asarray(array, np.float32)


def require_shape(name: str, array, shape):
    """The array; ValueError if its shape is another, see `require_array`. For traced ones, too."""
    letters = _is_array(array) and getattr(array.dtype, "kind", "f") in "OSUMm"
    if not _is_array(array) or letters:
        raise refuse(name, array, f"an array {'' if shape is None else shape_text(shape)}".strip())
    if shape is None:
        return array
    leading = len(shape) > 0 and shape[0] == "..."
    wanted, given = (shape[1:] if leading else shape), tuple(array.shape)
    tail = given[len(given) - len(wanted) :] if leading and len(given) >= len(wanted) else given
    fits = len(tail) == len(wanted) and all(
        length == want or (isinstance(want, str) and length > 0)
        for length, want in zip(tail, wanted, strict=True)
    )
    if not fits:
        raise ValueError(
            f"{name} has shape {given}; expected {shape_text(shape)}"
            + (", where letters stand for lengths of at least 1" * any(map(_is_letter, wanted)))
        )
    return array


def _is_letter(length) -> bool:
    return isinstance(length, str)


def shape_text(shape) -> str:
    """A shape as error messages print it, such as "[N, 3]"."""
    return f"[{', '.join(map(str, shape))}]"


def require_key(name: str, value, shape=()):
    """The value, a JAX PRNG key (or keys of that leading shape); ValueError if it is none."""
    import jax

    expected = "jax.random.PRNGKey(0)" if shape == () else f"keys {shape_text(shape)}"
    try:
        if jax.dtypes.issubdtype(value.dtype, jax.dtypes.prng_key):
            return require_shape(name, value, shape)
        right = value.dtype == np.uint32 and len(value.shape) > 0
    except (AttributeError, TypeError):
        right = False
    if not right:
        raise refuse(name, value, f"a PRNG key, such as {expected}")
    return require_shape(name, value, (*shape, 2))


# ------------------------------------------------------------------ texts, names, files, functions


def require_text(name: str, value, longest: int = 1000) -> str:
    """The value; ValueError if it is no text of at most `longest` characters."""
    if not isinstance(value, str) or len(value) > longest:
        raise refuse(name, value, f"a text of at most {longest:,} characters")
    return value


def require_name(name: str, value) -> str:
    """The value; ValueError if a file or folder cannot have that name on every system.

    Refused are texts that lead elsewhere (separators, "..", "~") or that file systems refuse.
    """
    right = isinstance(value, str) and value.isprintable() and value.strip() == value != ""
    right = right and not set(value) & set('/\\:*?"<>|') and value[0] not in ".~-"
    # 55 bytes are left for what is added: suffixes, and those of temporary files.
    if not right or len(value.encode(errors="replace")) > LONGEST_PART - 55:
        raise refuse(
            name,
            value,
            "the name of a file or folder, without separators: letters, digits and signs such as "
            f"_ - + ., at most {LONGEST_PART - 55} bytes",
        )
    return value


def require_path(name: str, value) -> Path:
    """The value as a Path, "~" expanded; ValueError if no file or folder can be there."""
    expected = "a path, as a text or Path"
    if not isinstance(value, str | os.PathLike) or isinstance(value, bytes):
        raise refuse(name, value, expected, kind=TypeError)
    text = os.fspath(value)
    if not isinstance(text, str) or not text.strip() or "\x00" in text:
        raise refuse(name, text, f"{expected}, not empty and without NUL characters")
    try:
        parts = [os.fsencode(part) for part in Path(text).parts]
    except UnicodeEncodeError as error:
        raise refuse(name, text, f"{expected}, of characters that file names can have") from error
    if len(os.fsencode(text)) > LONGEST_PATH or max(map(len, parts), default=0) > LONGEST_PART:
        raise refuse(
            name,
            text,
            f"{expected}, of at most {LONGEST_PATH:,} characters with at most {LONGEST_PART} "
            "between two separators",
        )
    try:
        return Path(text).expanduser()
    except RuntimeError as error:
        raise ValueError(
            f"{name} is {shown(text)}, whose home folder is unknown here ({error}); give the path "
            "without ~, or set HOME"
        ) from error


def require_output(name: str, value) -> Path:
    """The value as the Path of a file to be written; ValueError if it is that of a folder."""
    path = require_path(name, value)
    if path.is_dir():
        raise ValueError(f"{name} is {shown(str(value))}, a folder; expected the path of a file")
    return path


def require_folder(name: str, value) -> Path:
    """The value as the Path of a folder; FileNotFoundError if there is none."""
    path = require_path(name, value)
    if not path.is_dir():
        raise FileNotFoundError(f"{name} is {shown(str(value))}, where there is no folder")
    return path


def require_file(name: str, value) -> Path:
    """The value as the Path of a file; FileNotFoundError if there is none."""
    path = require_path(name, value)
    if not path.is_file():
        raise FileNotFoundError(f"{name} is {shown(str(value))}, where there is no file")
    return path


def require_function(name: str, value) -> Callable:
    """The value; TypeError if it cannot be called."""
    if not callable(value):
        raise refuse(name, value, "a function", kind=TypeError)
    return value


def require_list(name: str, value, most: int | None = None) -> list:
    """The values as a list; ValueError for what is no sequence, such as a text, or for too many."""
    unordered = str | bytes | Mapping | set | frozenset
    right = isinstance(value, Iterable) and not isinstance(value, unordered)
    try:
        values = list(value) if right else None
    except TypeError:  # an array without axes
        values = None
    if values is None:
        raise refuse(name, value, "a list")
    if most is not None and len(values) > most:
        raise ValueError(f"{name} has {len(values):,} entries; expected at most {most:,}")
    return values


def require_records(name: str, value, columns: Iterable[str]) -> list[dict]:
    """The value as a list; TypeError or ValueError if it holds no dictionaries with `columns`."""
    records = require_list(name, value)
    for record in records:
        require_kind(f"an entry of {name}", record, dict, "a record of a study")
        missing = [column for column in columns if column not in record]
        if missing:
            raise refuse(f"an entry of {name}", record, f"one with {', '.join(missing)}")
    return records
