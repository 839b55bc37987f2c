"""Which runs a user means: `field=qcolor`, `state=failed,interrupted`, `psnr>25`, or a part of their ids.

key=value      the column has the value; with commas any of them, with * and ? a pattern, `none` for no value
key!=value     the opposite
key<number     and <=, >, >=
text           a part of the id
"""

import difflib
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
import pandas as pd

from qnerf.config.compatibility import today_noted

ALIASES = {"id": "run_id", "tag": "tags"}
_FILTER = re.compile(r"([^=<>!]+)(!=|>=|<=|=|>|<)(.*)", re.DOTALL)
_ORDER: dict[str, Callable[[float, float], bool]] = {
    ">=": lambda a, b: a >= b,
    "<=": lambda a, b: a <= b,
    ">": lambda a, b: a > b,
    "<": lambda a, b: a < b,
}


@dataclass(frozen=True)
class Filter:
    """One condition on a column of the table of runs."""

    key: str
    operator: str
    value: str

    def matches(self, value: Any) -> bool:
        if self.operator in _ORDER:
            return isinstance(value, (int, float)) and _ORDER[self.operator](value, float(self.value))
        if self.operator == "in":
            return self.value in str(value)
        found = any(_equals(value, wanted) for wanted in self.value.split(","))
        return found if self.operator == "=" else not found


def parse(texts: Iterable[str]) -> list[Filter]:
    """Raises ValueError where `<` and `>` compare with something that is no number."""
    return [_parse(text) for text in texts]


def _parse(text: str) -> Filter:
    match = _FILTER.fullmatch(text)
    if match is None:
        return Filter("run_id", "in", text)
    key, operator, value = (part.strip() for part in match.groups())
    if operator in _ORDER:
        try:
            float(value)
        except ValueError:
            raise ValueError(f"{text}: {operator} compares numbers, got {value!r}") from None
    return Filter(column(key), operator, value)


def column(name: str) -> str:
    """The column's own name for `id` and `tag`, and today's for an old one, which is noted on standard error."""
    return today_noted(ALIASES.get(name.strip(), name.strip()))


def select(frame: pd.DataFrame, filters: Sequence[Filter]) -> pd.DataFrame:
    """The rows that meet every condition. Raises ValueError for a column that the table does not have."""
    keep = np.ones(len(frame), dtype=bool)
    for condition in filters:
        check_column(condition.key, frame.columns)
        keep &= np.array([condition.matches(value) for value in frame[condition.key].tolist()], dtype=bool)
    return frame[keep]


def check_column(name: str, known: Iterable[str]) -> str:
    """The name itself; ValueError with the nearest known ones if it is none of them."""
    known = list(known)
    if name in known:
        return name
    ends = [column for column in known if column.endswith(f".{name}")]
    near = ends[:6] or difflib.get_close_matches(name, known, n=4, cutoff=0.4) or known[:12]
    raise ValueError(f"no run has a column {name!r}; did you mean {', '.join(near)}?")


def _equals(value: Any, wanted: str) -> bool:
    if isinstance(value, (list, tuple)) and value:
        return any(_equals(item, wanted) for item in value)
    if value is None or value != value or value in ((), []):
        return wanted.lower() in ("none", "null", "nan")
    if isinstance(value, bool):
        return wanted.lower() == str(value).lower()
    if isinstance(value, (int, float)):
        try:
            return value == float(wanted)
        except ValueError:
            return False
    return fnmatchcase(str(value), wanted)
