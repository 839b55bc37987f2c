"""One-line errors for values that users give."""

from collections.abc import Sequence
from typing import Any, TypeGuard


def one_of(name: str, value: Any, choices: Sequence[Any]) -> None:
    """ValueError, which lists the choices, unless `value` is one of them.

    >>> one_of("background", "red", ("white", "black"))
    Traceback (most recent call last):
        ...
    ValueError: background must be one of white, black, got 'red'
    """
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(map(str, choices))}, got {value!r}")


def at_least(name: str, value: float, minimum: float) -> None:
    """ValueError unless `value` is a finite number of at least `minimum`."""
    if not minimum <= value < float("inf"):
        raise ValueError(f"{name} must be at least {minimum:g}, got {value}")


def is_number(value: object) -> TypeGuard[float]:
    """Whether the value is an int or a float. A bool is not a number here."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)
