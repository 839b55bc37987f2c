"""What the index holds of each file of a run: from its bytes to the names, kinds and values of one row."""

import json
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

from qnerf.config.compatibility import today
from qnerf.records import summary_row
from qnerf.records.index.locations import ANNOTATIONS, STATUS, SUMMARY
from qnerf.records.index.ragged_rows import KIND_OF_TYPE, Row, Rows, Shape
from qnerf.records.owner import moment
from qnerf.records.read import STATES

DAMAGED = ".damaged"
"""Name of the one value that an entry has whose file cannot be read: why."""

_UNREADABLE = Shape((DAMAGED,), ("text",))
_STATUS = Shape(
    ("state", "step", "created", "heartbeat", "error", "record"), ("text", "int", "float", "float", "text", "text")
)
_ANNOTATIONS = Shape(("tags", "note"), ("text", "text"))


def unreadable(run: str, stamp: str, reason: str) -> Row:
    return Row(run, stamp, _UNREADABLE, [_text(reason)])


def read(file: str, run: str, stamp: str, data: bytes) -> Row:
    """The entry of one file; `unreadable` where a summary is damaged. The other two are empty then."""
    try:
        shape, values = _READERS[file](data)
    except (ValueError, TypeError, OSError) as error:  # pyarrow's errors are these too
        return unreadable(run, stamp, f"{file} is damaged: {' '.join(str(error).split())}")
    return Row(run, stamp, shape, values)


def rows(read: Sequence[Row]) -> Rows:
    """All of them together; those that hold what their types do not allow become `unreadable`."""
    try:
        return Rows.of(read)
    except (ValueError, TypeError, OverflowError):
        return Rows.of(entry if _fits(entry) else _misfit(entry) for entry in read)


def _fits(entry: Row) -> bool:
    try:
        Rows.of([entry])
    except (ValueError, TypeError, OverflowError):
        return False
    return True


def _misfit(entry: Row) -> Row:
    return unreadable(
        entry.key, entry.stamp, f"{SUMMARY} is damaged: it has values that are not of their column's type"
    )


def _summary(data: bytes) -> tuple[Shape, Sequence[Any]]:
    names, types, values = summary_row.decode(data)
    if not len(names) == len(types) == len(values):
        raise ValueError("columns, types and values differ in number")
    shape = _shape(tuple(names), tuple(types))
    if not all(kind in KIND_OF_TYPE for kind in types):
        values = [
            _text(str(value)) if kind == "text" and value is not None else value
            for kind, value in zip(shape.kinds, values, strict=True)
        ]
    return shape, values


@lru_cache(maxsize=4096)
def _shape(names: tuple[str, ...], types: tuple[str, ...]) -> Shape:
    """One object for all runs whose columns are the same. Types that a run does not write are shown as text."""
    if not all(isinstance(name, str) for name in names):
        raise ValueError("names of columns must be text")
    return Shape(tuple(map(today, names)), tuple(KIND_OF_TYPE.get(kind, "text") for kind in types))


def _status(data: bytes) -> tuple[Shape, Sequence[Any]]:
    record = _object(data)
    state, step = record.get("state"), record.get("step")
    is_step = isinstance(step, int) and abs(step) < 2**63
    return _STATUS, (
        state if state in STATES else None,
        int(step) if is_step else None,  # type: ignore[arg-type]
        moment(record.get("created")),
        moment(record.get("heartbeat")),
        _text(record.get("error")),
        json.dumps(record) if state == "running" else None,
    )


def _annotations(data: bytes) -> tuple[Shape, Sequence[Any]]:
    record = _object(data)
    tags = record.get("tags")
    texts = {tag for tag in tags if isinstance(tag, str)} if isinstance(tags, list) else set()
    return _ANNOTATIONS, (json.dumps(sorted(texts)), _text(record.get("note")))


def _object(data: bytes) -> dict[str, Any]:
    """A JSON object; empty where the file holds anything else."""
    try:
        record = json.loads(data)
    except (ValueError, RecursionError):
        return {}
    return record if isinstance(record, dict) else {}


def _text(value: Any) -> str | None:
    """Text that Arrow takes: JSON may hold halves of characters."""
    return value.encode(errors="replace").decode() if isinstance(value, str) and value else None


_READERS: dict[str, Callable[[bytes], tuple[Shape, Sequence[Any]]]] = {
    SUMMARY: _summary,
    STATUS: _status,
    ANNOTATIONS: _annotations,
}
