"""The table of runs as compact JSON: a column at a time, rounded, constants and repeated texts once."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

DIGITS = 6  # significant ones of a number on the page


def packed(frame: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """Each column that has a value: `{all: v}`, `{levels, codes}` or `{values}`, with None for what is absent."""
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
    levels, codes = _levels(column)
    if all(level is None for level in levels):
        return None
    if len(levels) == 1:
        return {"all": levels[0]}
    if len(levels) > len(codes) // 2 or all(isinstance(level, (int, float, type(None))) for level in levels):
        return {"values": [levels[code] for code in codes]}
    return {"levels": levels, "codes": codes}


def _levels(column: pd.Series) -> tuple[list[Any], list[int]]:
    """The column's different plain values, and for each row the number of its own."""
    text = column.dtype == object and pd.api.types.infer_dtype(column) == "string"
    if text or column.dtype.kind in "iuf":
        codes, levels = pd.factorize(column, use_na_sentinel=False)
        return _merged([plain(level) for level in levels.tolist()], codes.tolist())
    # A list cannot be a key, and True would meet 1 as one.
    return _merged([plain(value) for value in column], list(range(len(column))))


def _merged(values: list[Any], codes: list[int]) -> tuple[list[Any], list[int]]:
    """The same with each value once: the text of a value tells it from all others."""
    levels = {repr(value): value for value in values}
    number = {text: place for place, text in enumerate(levels)}
    merged = [number[repr(value)] for value in values]
    return list(levels.values()), [merged[code] for code in codes]
