"""The table of runs as compact JSON: a column at a time, rounded, constants and repeated texts once."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

DIGITS = 6  # significant ones of a number on the page


def packed(frame: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """Each column that has a value: `{all: v}`, `{levels, codes}` or `{values}`, with None for what is absent."""
    columns = {str(name): [plain(value) for value in frame[name]] for name in frame.columns}
    return {name: _packed(values) for name, values in columns.items() if any(value is not None for value in values)}


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


def _packed(values: list[Any]) -> dict[str, Any]:
    # A list cannot be a key, and True would meet 1 as one: the text of a value tells it from all others.
    levels = {repr(value): value for value in values}
    if len(levels) == 1:
        return {"all": values[0]}
    if len(levels) > len(values) // 2 or all(isinstance(value, (int, float, type(None))) for value in values):
        return {"values": values}
    codes = {text: code for code, text in enumerate(levels)}
    return {"levels": list(levels.values()), "codes": [codes[repr(value)] for value in values]}
