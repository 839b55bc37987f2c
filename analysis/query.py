"""Choosing runs by what is in their columns, with the same text as `qnerf runs`: `field=qcolor seed=0,1 'psnr>25'`."""

import json
import shlex
from collections.abc import Mapping
from typing import Any

import pandas as pd

from qnerf.records import filters

HELP = "only these runs, as `qnerf runs` takes it: \"field=qcolor seed=0,1 'psnr>25'\""


def select(frame: pd.DataFrame, condition: str | Mapping[str, Any]) -> pd.DataFrame:
    """The rows that meet every filter of a text (see `qnerf.records.filters`), or whose columns have the given values.

    Of values by column a list means any of them, None no value; a value of `tags` is one of the run's tags.

    Raises:
        ValueError: no such column (the line names near ones), or no such row (it tells what there is).
    """
    if isinstance(condition, str):
        try:
            parsed = filters.parse(shlex.split(condition))
        except ValueError as error:  # an open quote, or `<` with something that is no number
            raise ValueError(f"filter {condition!r}: {error}") from error
        names, told = [item.key for item in parsed], condition
        chosen = filters.select(frame, parsed)
    else:
        condition = {filters.column(name): value for name, value in condition.items()}
        names, told = list(condition), ", ".join(f"{name}={value}" for name, value in condition.items())
        chosen = frame[_valued(frame, condition)]
    if chosen.empty:
        there = "; ".join(f"{name}: {known(frame[name])}" for name in dict.fromkeys(names))
        raise ValueError(f"none of {len(frame):,} runs has {told}; there are {there}")
    return chosen


def known(column: pd.Series, most: int = 8) -> str:
    """The values of a column in words: all of them, the first of many, or the range of many numbers."""
    column = column.explode() if column.name == "tags" else column
    values = column.dropna()
    distinct = sorted(values.unique(), key=lambda value: (str(type(value)), value))
    if len(distinct) > most and pd.api.types.is_numeric_dtype(values):
        return f"{values.min():.6g} to {values.max():.6g}"
    texts = [str(value) for value in distinct[:most]]
    return ", ".join(texts) + (f" and {len(distinct) - most} more" if len(distinct) > most else "") or "no values"


def _valued(frame: pd.DataFrame, values: Mapping[str, Any]) -> pd.Series:
    keep = pd.Series(True, index=frame.index)
    for name, wanted in values.items():
        column = frame[filters.check_column(name, frame.columns)]
        several = wanted if isinstance(wanted, (list, tuple, set, frozenset, range)) else [wanted]
        keep &= pd.concat([_has(column, value) for value in several], axis=1).any(axis=1) if several else False
    return keep


def _has(column: pd.Series, value: Any) -> pd.Series:
    if column.name == "tags":
        return column.map(lambda tags: value in tags).astype(bool)
    if value is None:
        return column.isna()
    # A column that is a number in some runs and text in others is text.
    if not isinstance(value, str) and pd.api.types.infer_dtype(column) == "string":
        value = json.dumps(value)
    return (column == value).fillna(False).astype(bool)
