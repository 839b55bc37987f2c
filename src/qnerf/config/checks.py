"""What counts as a number."""

from typing import TypeGuard


def is_number(value: object) -> TypeGuard[float]:
    """Whether the value is an int or a float. A bool is not a number here."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)
