"""Which runs a user means: `field=qcolor`, `state=failed,interrupted`, `psnr>25`, or a part of their ids.

key=value      the column has the value; with commas any of them, with * and ? a pattern, `none` for no value; a list
               as `[128,64]`
key!=value     the opposite
key<number     and <=, >, >=
text           a part of the id

A run must meet every condition. They are separated by spaces, or by a comma before the next `key=`:
`field=classical,color=3x64` is two.
"""

import difflib
import math
import operator
import re
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
import pandas as pd

from qnerf.config.checks import is_number

ALIASES = {"id": "run_id", "scene": "scene_name", "colour": "color"}
"""Other names of columns, wherever a user names one. `scene.name` is how a scene is read."""
HELP = "only these runs, as `qnerf runs` takes it: \"field=qcolor seed=0,1 'psnr>25'\""
_CONDITION = re.compile(r"([^=<>!,]+)(!=|>=|<=|=|>|<)(.*)", re.DOTALL)
_COMMA = re.compile(r",(?![^\[]*\])")  # not inside a list
_NEXT_KEY = re.compile(r",(?=[^=<>!,]+(?:!=|>=|<=|=|>|<))")
_ORDER: dict[str, Callable[[float, float], bool]] = {
    ">=": operator.ge, "<=": operator.le, ">": operator.gt, "<": operator.lt,
}  # fmt: skip


@dataclass(frozen=True)
class Filter:
    """One condition on a column of a table of runs; `values` are alternatives."""

    key: str
    operator: str
    values: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.key}{self.operator}{','.join(self.values)}"

    def matches(self, value: Any) -> bool:
        if self.operator in _ORDER:
            return is_number(value) and _ORDER[self.operator](value, float(self.values[0]))
        if self.operator == "in":
            return self.values[0] in str(value)
        return any(_equals(value, wanted) for wanted in self.values) == (self.operator == "=")


def parse(conditions: str | Iterable[str] | Mapping[str, Any]) -> list[Filter]:
    """The conditions of a text, of several such as the command line gives, or of values by column.

    >>> [str(condition) for condition in parse("field=qcolor,qboth seed!=0")]
    ['field=qcolor,qboth', 'seed!=0']
    >>> parse({"field": "qcolor", "seed": [0, 1]}) == parse("field=qcolor,seed=0,1")
    True

    Raises:
        ValueError: a quote is left open, or `<` or `>` compares with something that is no number.
    """
    if isinstance(conditions, Mapping):
        return [Filter(column(key), "=", _alternatives(value)) for key, value in conditions.items()]
    if isinstance(conditions, str):
        try:
            return parse(shlex.split(conditions))
        except ValueError as error:
            raise ValueError(f"filter {conditions!r}: {error}") from error
    return [_parse(part) for text in conditions for part in _NEXT_KEY.split(text)]


def _parse(text: str) -> Filter:
    match = _CONDITION.fullmatch(text)
    if match is None:
        return Filter("run_id", "in", (text,))
    key, comparison, value = (part.strip() for part in match.groups())
    if comparison in _ORDER and math.isnan(_number(value)):
        raise ValueError(f"{text}: {comparison} compares numbers, got {value!r}")
    return Filter(column(key), comparison, (value,) if comparison in _ORDER else tuple(_COMMA.split(value)))


def _alternatives(value: Any) -> tuple[str, ...]:
    several = value if isinstance(value, (list, tuple, set, frozenset, range)) else [value]
    return tuple(str(item).lower() if item is None or isinstance(item, bool) else str(item) for item in several)


def column(name: str) -> str:
    """The column's own name for any in `ALIASES`, also of a group: `colour.mlp.width`."""
    first, dot, rest = name.strip().partition(".")
    return f"color.{rest}" if dot and first == "colour" else ALIASES.get(name.strip(), name.strip())


def select(frame: pd.DataFrame, filters: Sequence[Filter]) -> pd.DataFrame:
    """The rows that meet every condition. Raises ValueError for a column that the table does not have."""
    mask = np.ones(len(frame), dtype=bool)
    for condition in filters:
        values = frame[check_column(condition.key, frame.columns)]
        mask &= np.array([condition.matches(value) for value in values.tolist()], dtype=bool)
    return frame[mask]


def require(frame: pd.DataFrame, conditions: str | Mapping[str, Any], rows: str = "runs") -> pd.DataFrame:
    """`select` of the parsed conditions.

    Raises:
        ValueError: as `parse` and `select` do, or no row is left; the message lists the columns' values.
    """
    filters = parse(conditions)
    chosen = select(frame, filters)
    if chosen.empty:
        text = conditions if isinstance(conditions, str) else ", ".join(f"{key}={v}" for key, v in conditions.items())
        raise ValueError(f"no {rows.removesuffix('s')} of {len(frame):,} has {text}; {there_are(frame, filters)}")
    return chosen


def there_are(frame: pd.DataFrame, filters: Sequence[Filter]) -> str:
    """The values of the filters' columns, for a message that no row meets them."""
    keys = dict.fromkeys(check_column(item.key, frame.columns) for item in filters)
    return "there are " + "; ".join(f"{key}: {known_values(frame[key])}" for key in keys)


def known_values(column: pd.Series, limit: int = 8) -> str:
    """The values of a column in words: all of them, the first of many, or the range of many numbers."""
    values = column.dropna()
    distinct = sorted(values.unique(), key=lambda value: (str(type(value)), value))
    if len(distinct) > limit and pd.api.types.is_numeric_dtype(values):
        return f"{values.min():.6g} to {values.max():.6g}"
    more = f" and {len(distinct) - limit} more" if len(distinct) > limit else ""
    shown = (f"{value:.6g}" if isinstance(value, float) else str(value) for value in distinct[:limit])
    return ", ".join(shown) + more or "no values"


def check_column(name: str, known: Iterable[str]) -> str:
    """The known column that a user means: in `ALIASES`, and for an option of a tracked run, its name without `train.`.

    ValueError with the nearest known ones where there is none.
    """
    known, name = list(known), column(name)
    if found := next((own for own in (name, f"train.{name}") if own in known), None):
        return found
    ends = [column for column in known if column.endswith(f".{name}")]
    near = ends[:6] or difflib.get_close_matches(name, known, n=4, cutoff=0.4) or known[:12]
    raise ValueError(f"no run has a column {name!r}; did you mean {', '.join(near)}?")


def _equals(value: Any, wanted: str) -> bool:
    if isinstance(value, (list, tuple)) and value:
        return any(_equals(item, wanted) for item in value)
    if value is None or value != value or value in ((), []):
        return wanted.lower() in ("none", "null", "nan")
    if isinstance(value, (bool, np.bool_)):
        return wanted.lower() == str(value).lower()
    if wanted.startswith("[") and wanted.endswith("]"):
        return str(value).replace(" ", "") == wanted.replace(" ", "")
    if isinstance(value, (int, np.integer)) and re.fullmatch(r"-?\d+", wanted):  # floats merge large ones
        return int(value) == int(wanted)
    # A column that is a number in some runs and text in others holds text: 10 is "10.0" there.
    return _number(value) == _number(wanted) or (
        not is_number(value) and fnmatchcase(str(value), wanted.replace("[", "[[]"))
    )


def _number(value: Any) -> float:
    """NaN for what is no number."""
    try:
        return math.nan if "_" in str(value) else float(value)
    except (TypeError, ValueError):
        return math.nan
