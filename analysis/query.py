"""Choosing runs by what is in their columns.

A query is comparisons of columns with values, joined by and, or, not and parentheses:

    field == 'qcolor' and qiren.layers > 1
    scene_name in ['fox', 'poster'] and not 20 <= psnr < 25

Columns whose names are no plain words stand in backticks: `time.field_ms` may, but need not. Nothing else is a query:
no call, no attribute, no index, so that a text from anywhere can only choose.
"""

import ast
import difflib
import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

LONGEST = 2000  # characters of a query
_TOKEN = re.compile(r"""('(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*")|`([^`]*)`""")
_ALLOWED = (
    ast.Expression, ast.BoolOp, ast.And, ast.Or, ast.UnaryOp, ast.Not, ast.USub, ast.UAdd, ast.Invert, ast.BinOp,
    ast.BitAnd, ast.BitOr, ast.Compare, ast.Eq, ast.NotEq, ast.Lt, ast.LtE, ast.Gt, ast.GtE, ast.In, ast.NotIn,
    ast.Name, ast.Load, ast.Constant, ast.List, ast.Tuple,
)  # fmt: skip
_VALUES = (str, int, float, bool)
_HINT = "expected comparisons such as \"field == 'qcolor' and qiren.layers > 1\""


def select(frame: pd.DataFrame, condition: str | Mapping[str, Any]) -> pd.DataFrame:
    """The rows that meet a query, or whose columns have the given values: a list means any of them, None no value; a
    value of `tags` is one of the run's tags.

    Raises:
        ValueError: not a query, no such column (the line names near ones), or no such row (it tells what there is).
    """
    if isinstance(condition, str):
        names, keep = _queried(frame, condition)
    else:
        names, keep = list(condition), _valued(frame, condition)
    if not keep.any():
        there = "; ".join(f"{name}: {known(frame[name])}" for name in names)
        raise ValueError(f"none of {len(frame):,} runs has {_told(condition)}; there are {there}")
    return frame[keep]


def known(column: pd.Series, most: int = 8) -> str:
    """The values of a column in words: all of them, the first of many, or the range of many numbers."""
    column = column.explode() if column.name == "tags" else column
    values = column.dropna()
    distinct = sorted(values.unique(), key=lambda value: (str(type(value)), value))
    if len(distinct) > most and pd.api.types.is_numeric_dtype(values):
        return f"{values.min():.6g} to {values.max():.6g}"
    texts = [str(value) for value in distinct[:most]]
    return ", ".join(texts) + (f" and {len(distinct) - most} more" if len(distinct) > most else "") or "no values"


def check_column(frame: pd.DataFrame, name: str) -> str:
    """The name itself; ValueError with the nearest ones if it is no column."""
    if name in frame.columns:
        return name
    ends = [column for column in frame.columns if column.endswith(f".{name}")]
    near = ends or difflib.get_close_matches(name, frame.columns, n=5, cutoff=0.4) or list(frame.columns[:12])
    raise ValueError(f"no run has a column {name!r}; near ones: {', '.join(near)}")


def _valued(frame: pd.DataFrame, values: Mapping[str, Any]) -> pd.Series:
    keep = pd.Series(True, index=frame.index)
    for name, wanted in values.items():
        column = frame[check_column(frame, name)]
        several = wanted if isinstance(wanted, (list, tuple, set, frozenset, range)) else [wanted]
        keep &= pd.concat([_has(column, value) for value in several], axis=1).any(axis=1) if several else False
    return keep


def _has(column: pd.Series, value: Any) -> pd.Series:
    if column.name == "tags":
        return column.map(lambda tags: value in tags).astype(bool)
    if value is None:
        return column.isna()
    if (
        not isinstance(value, str) and pd.api.types.infer_dtype(column) == "string"
    ):  # numbers in some runs, text in others
        value = json.dumps(value)
    return (column == value).fillna(False).astype(bool)


def _queried(frame: pd.DataFrame, text: str) -> tuple[list[str], pd.Series]:
    """The columns that a query speaks of, and the rows that meet it."""
    try:
        tree, names = _parsed(text)
        columns = [check_column(frame, name) for name in names]
        data = frame[columns].set_axis([_stand_in(number) for number in range(len(columns))], axis=1)
        keep = data.eval(ast.unparse(tree), engine="python")
    except (SyntaxError, TypeError, RecursionError, MemoryError) as error:
        raise ValueError(f"{text[:200]!r} is no query: {' '.join(str(error).split())}; {_HINT}") from error
    if not isinstance(keep, pd.Series) or keep.dtype != bool:
        raise ValueError(f"{text[:200]!r} is no query: it compares nothing; {_HINT}")
    return columns, keep


def _parsed(text: str) -> tuple[ast.AST, list[str]]:
    """The query with a plain word for every column, and the columns' names.

    SyntaxError: it holds anything but columns, values and comparisons.
    """
    if len(text) > LONGEST:
        raise SyntaxError(f"it has more than {LONGEST:,} characters")
    quoted: list[str] = []

    def unquoted(token: re.Match[str]) -> str:
        if token[1] is not None:
            return token[1]
        quoted.append(token[2])
        return f" _quoted[{len(quoted) - 1}] "

    if "\0" in text:
        raise SyntaxError("it holds a null character")
    columns = _Columns(quoted)
    tree = columns.visit(ast.parse(_TOKEN.sub(unquoted, text).strip(), mode="eval"))
    for node in ast.walk(tree):
        if not isinstance(node, _ALLOWED) or (isinstance(node, ast.Constant) and type(node.value) not in _VALUES):
            told = repr(node.value) if isinstance(node, ast.Constant) else type(node).__name__.lower()
            raise SyntaxError(f"{told} has no place in one")
    return tree, columns.names


class _Columns(ast.NodeTransformer):
    """Puts plain words in the place of columns: `a`, `a.b.c`, and those that stood in backticks."""

    def __init__(self, quoted: Sequence[str]) -> None:
        self._quoted = quoted
        self.names: list[str] = []

    def visit_Name(self, node: ast.Name) -> ast.Name:
        return self._column(node.id)

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        return self._column(ast.unparse(node)) if _is_dotted(node) else node

    def visit_Subscript(self, node: ast.Subscript) -> ast.AST:
        number = node.slice.value if isinstance(node.slice, ast.Constant) else None
        is_quoted = ast.unparse(node.value) == "_quoted" and isinstance(number, int) and 0 <= number < len(self._quoted)
        return self._column(self._quoted[number]) if is_quoted else node  # type: ignore[index]

    def _column(self, name: str) -> ast.Name:
        if name not in self.names:
            self.names.append(name)
        return ast.Name(_stand_in(self.names.index(name)), ast.Load())


def _is_dotted(node: ast.AST) -> bool:
    return isinstance(node, ast.Name) or (isinstance(node, ast.Attribute) and _is_dotted(node.value))


def _stand_in(number: int) -> str:
    return f"column{number}"


def _told(condition: str | Mapping[str, Any]) -> str:
    if isinstance(condition, str):
        return condition
    return ", ".join(f"{name}={value}" for name, value in condition.items())
