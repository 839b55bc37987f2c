"""Tables as CSV that a spreadsheet opens without running anything in them."""

from typing import Any

import pandas as pd

_STARTS = ("=", "+", "-", "@", "\t", "\r", "\n", "＝", "＋", "－", "＠")  # noqa: RUF001  spreadsheets take these for ASCII


def as_csv(frame: pd.DataFrame) -> str:
    """The table as CSV without its index; text that would be a formula is neutralised, in headers too."""
    safe = frame.map(without_formula)
    safe.columns = [without_formula(name) for name in frame.columns]
    return safe.to_csv(index=False, lineterminator="\n")


def without_formula(value: Any) -> Any:
    """Puts an apostrophe before text that a spreadsheet would run as a formula; numbers stay.

    >>> without_formula("=1+1"), without_formula("-1e3"), without_formula(-3)
    ("'=1+1", '-1e3', -3)
    """
    if not isinstance(value, str) or not value.startswith(_STARTS):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value
