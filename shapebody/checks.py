"""Checks of arguments that several modules share."""

import numbers


def require_integer(name: str, value, least: int = 0) -> int:
    """The value as an int; ValueError if it is no integer of at least `least`."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral) or value < least:
        raise ValueError(f"{name} is {value!r}; expected an integer of at least {least}")
    return int(value)


def require_kind(name: str, value, kind: type, hint: str) -> None:
    """TypeError if the value is no instance of `kind`; `hint` says how to come by one."""
    if not isinstance(value, kind):
        article = "an" if kind.__name__[0] in "AEIOU" else "a"
        raise TypeError(f"{name} is {value!r}; expected {article} {kind.__name__}: {hint}")
