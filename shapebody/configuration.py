"""Settings as frozen, typed dataclasses: what does not fit a field's type is refused in one line.

A configuration is hashable (a static argument of `jax.jit`), is changed with
`dataclasses.replace`, and goes to JSON and back (`to_json`, `from_json`). The types below say in
words what a field takes; pydantic checks them.
"""

import dataclasses
import functools
import json
import math
from typing import Annotated, Any

import numpy as np
import pydantic
from pydantic import BeforeValidator, Field, WrapValidator
from pydantic_core import PydanticCustomError, ValidationError

from shapebody.arguments import LARGEST, SEEDS, require_name, shown


def configuration(cls):
    """Class decorator: a frozen dataclass that checks every value against its field's type.

    Checks that concern several fields go into the class's `__post_init__`, as ValueErrors.
    Creating one raises ValueError, which names the field, its value and what was expected.
    """
    settings = pydantic.ConfigDict(strict=True, extra="forbid", arbitrary_types_allowed=True)
    checked = pydantic.dataclasses.dataclass(frozen=True, config=settings)(cls)
    create = checked.__init__

    @functools.wraps(create)
    def __init__(self, *values, **named):
        try:
            create(self, *values, **named)
        except ValidationError as error:
            raise ValueError(_explained(error, cls.__name__)) from None

    checked.__init__ = __init__
    return checked


def to_json(config) -> dict:
    """A configuration as it reads back from JSON: tuples are lists, inf is the text "Infinity"."""
    return json.loads(json.dumps(dataclasses.asdict(config)), parse_constant=str)


def from_json(kind, values, what: str = ""):
    """The inverse of `to_json`: a configuration of class `kind` from what was read from JSON.

    Fields that are not given keep their defaults. Raises ValueError, which names the field, for an
    unknown one and for a value that the field does not take.
    """
    what = what or kind.__name__
    if not isinstance(values, dict):
        raise ValueError(f"{what} is {shown(values)}; expected an object with settings")
    try:
        return _adapter(kind).validate_json(json.dumps(values))
    except ValidationError as error:
        raise ValueError(f"{what}: {_explained(error, kind.__name__)}") from None


@functools.cache
def _adapter(kind) -> pydantic.TypeAdapter:
    return pydantic.TypeAdapter(kind)


def _explained(error: ValidationError, owner: str) -> str:
    """Pydantic's report as one line in the style of all errors here."""
    found = error.errors(include_url=False)
    first = found[0]
    place = [part for part in first["loc"] if not _is_step(part)]
    name = ".".join(map(str, place)).replace(".[", "[") or owner
    if first["type"] == "value_error":  # of a __post_init__
        text = str(first["ctx"]["error"])
    elif first["type"] in ("unexpected_keyword_argument", "unexpected_positional_argument"):
        text = f"{owner} has no setting {name!r}"
    elif first["type"] in ("missing", "missing_argument", "missing_keyword_only_argument"):
        text = f"{name} of {owner} is missing"
    else:
        expected = first["msg"]
        if first["type"] != "expected":
            expected = expected.replace("Input should be ", "").replace("valid ", "")
        text = f"{name} is {shown(first['input'])}; expected {expected}"
    others = len({str(one["loc"][:1]) for one in found}) - 1
    return text + (f" (and {others} more)" if others else "")


def _is_step(part) -> bool:
    """Whether a part of a place in an error is pydantic's name of a step, not a field or index."""
    return isinstance(part, str) and not part.isidentifier()


# ------------------------------------------------------------------ types of fields


def expecting(words: str) -> WrapValidator:
    """What a field takes, in words: they stand in the error for whatever it does not take."""

    def check(value, handler):
        try:
            return handler(value)
        except (ValidationError, ValueError, TypeError) as error:
            raise PydanticCustomError("expected", "{words}", {"words": words}) from error

    return WrapValidator(check)


def as_python(value):
    """Numbers of NumPy as Python's, "Infinity" from JSON as inf."""
    if isinstance(value, np.generic):
        return value.item()
    return math.inf if value == "Infinity" else value


def as_tuple(value):
    """Lists and arrays as tuples of Python's numbers."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    return tuple(value) if isinstance(value, list) else value


Flag = Annotated[bool, BeforeValidator(as_python), expecting("True or False")]


def integer(least: int = 1, most: int = LARGEST) -> Any:
    """Type of an integer from `least` to `most`."""
    words = f"an integer of at least {least}" if most == LARGEST else ""
    words = words or f"an integer from {least} to {most:,}"
    return Annotated[int, Field(ge=least, le=most), BeforeValidator(as_python), expecting(words)]


def number(words: str, **bounds) -> Any:
    """Type of a finite number, in words and with pydantic's bounds (gt, ge, lt, le)."""
    kind = Field(allow_inf_nan=False, **bounds)
    return Annotated[float, kind, BeforeValidator(as_python), expecting(words)]


def sequence(kind, words: str, least: int = 1, most: int = 100) -> Any:
    """Type of a tuple of `least` to `most` values of one type."""
    length = Field(min_length=least, max_length=most)
    return Annotated[tuple[kind, ...], length, BeforeValidator(as_tuple), expecting(words)]


Count = integer(1)
Seed = integer(0, SEEDS - 1)
Finite = number("a finite number")
Positive = number("a positive number", gt=0)
NonNegative = number("a finite number of at least 0", ge=0)
Probability = number("a probability, from 0 to 1", ge=0, le=1)
Share = number("a number above 0 and at most 1", gt=0, le=1)
Threshold = Annotated[
    float, Field(gt=0), BeforeValidator(as_python), expecting("a positive number, or inf for none")
]
Pair = Annotated[
    tuple[NonNegative, NonNegative],
    BeforeValidator(as_tuple),
    expecting("two numbers of at least 0"),
]
FileName = Annotated[str, BeforeValidator(functools.partial(require_name, "name"))]
