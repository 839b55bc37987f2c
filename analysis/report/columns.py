"""The table of runs as compact JSON: a column at a time, rounded, constants once."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

DIGITS = 6  # significant ones of a number on the page


def packed(frame: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """Each column that has a value: `{values}`, or `{all: v}` where all are the same; None for what is absent."""
    return {str(name): found for name in frame.columns if (found := _packed(frame[name])) is not None}


def plain(value: Any) -> Any:
    """A value that JSON has: numbers rounded to `DIGITS`, None for NaN and infinities, anything else as text."""
    if value is None or value is pd.NA or value is pd.NaT:
        return None
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return rounded(float(value))
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(item) for item in value]
    return str(value)


def rounded(number: float, digits: int = DIGITS) -> float | int | None:
    """To `digits` significant digits, whole numbers as they are; None where it is not finite."""
    if not math.isfinite(number):
        return None
    return int(number) if number.is_integer() and abs(number) < 2**53 else float(f"{number:.{digits}g}")


def rounded_all(numbers: Sequence[float] | np.ndarray, digits: int = DIGITS) -> list[float | int | None]:
    return [rounded(number, digits) for number in np.asarray(numbers, dtype=float).tolist()]


def _packed(column: pd.Series) -> dict[str, Any] | None:
    values = [plain(value) for value in column]
    if len({repr(value) for value in values}) > 1:
        return {"values": values}
    return None if not values or values[0] is None else {"all": values[0]}
