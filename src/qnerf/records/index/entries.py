"""What the index holds of each file of a run: from the file's bytes to the names, kinds and values of one row."""

import json
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

from qnerf.config.compatibility import today
from qnerf.records import summary_row
from qnerf.records.files import StoreError, parse_json
from qnerf.records.index.locations import ANNOTATIONS, STATUS, SUMMARY
from qnerf.records.index.ragged_rows import RaggedRow, RaggedTable, RowShape
from qnerf.records.owner import unix_time
from qnerf.records.parquet import KINDS, reading
from qnerf.records.read import STATES
from qnerf.records.schemas import check_status, summary_kinds

DAMAGED = ".damaged"
"""The one value in the entry of a file that cannot be read: the reason."""

_UNREADABLE_SHAPE = RowShape((DAMAGED,), ("text",))
_STATUS_SHAPE = RowShape(
    ("state", "step", "created", "heartbeat", "error", "record"), ("text", "int", "float", "float", "text", "text")
)
_ANNOTATIONS_SHAPE = RowShape(("tags", "note"), ("text", "text"))


def unreadable(run: str, stamp: str, reason: str) -> RaggedRow:
    return RaggedRow(run, stamp, _UNREADABLE_SHAPE, [_text(reason)])


def parse(file: str, run: str, stamp: str, data: bytes) -> RaggedRow:
    """The entry of one file: `unreadable` for a damaged summary or status, empty for damaged annotations."""
    try:
        with reading(file):
            shape, values = _PARSERS[file](data)
    except StoreError as error:
        return unreadable(run, stamp, str(error))
    return RaggedRow(run, stamp, shape, values)


def check_shape(file: str, shape: RowShape) -> None:
    """ValueError if no entry of the file has this shape."""
    if shape == _UNREADABLE_SHAPE:
        return
    if file != SUMMARY:
        expected = {STATUS: _STATUS_SHAPE, ANNOTATIONS: _ANNOTATIONS_SHAPE}[file]
        if shape != expected:
            raise ValueError(f"expected {expected}, got {shape}")
    elif shape.kinds != summary_kinds(shape.names, tuple(str(KINDS[kind]) for kind in shape.kinds)):
        raise ValueError(f"expected kinds {list(KINDS)}, got {shape.kinds}")


def check(file: str, entries: RaggedTable) -> None:
    """ValueError for values of a status or of annotations that `parse` does not give."""
    if file == STATUS:
        names = [name for name in _STATUS_SHAPE.names if name != "record"]
        for values in zip(*map(entries.values, names), strict=True):
            check_status(dict(zip(names, values, strict=True)))
        if not set(entries.values("state")) <= {*STATES, None}:
            raise ValueError(f"state: expected one of {', '.join(STATES)}")
        for record in filter(None, entries.values("record")):
            check_status(parse_json(record.encode()))
    if file == ANNOTATIONS:
        for tags in filter(None, entries.values("tags")):
            if tags != json.dumps(_tags(parse_json(b'{"tags": %s}' % tags.encode()))):
                raise ValueError("tags: expected a sorted list of texts")


def table(entries: Sequence[RaggedRow]) -> RaggedTable:
    """All entries together. One whose values do not fit their types becomes `unreadable`."""
    try:
        return RaggedTable.of(entries)
    except (ValueError, TypeError, OverflowError):
        return RaggedTable.of(_checked(entry) for entry in entries)


def _checked(entry: RaggedRow) -> RaggedRow:
    try:
        RaggedTable.of([entry])
    except (ValueError, TypeError, OverflowError):
        reason = f"{SUMMARY}: damaged: it has values that are not of their column's type"
        return unreadable(entry.key, entry.stamp, reason)
    return entry


def _parse_summary(data: bytes) -> tuple[RowShape, Sequence[Any]]:
    names, types, values = summary_row.decode(data)
    if not len(names) == len(types) == len(values):
        raise ValueError("columns, types and values differ in number")
    return _shape(tuple(names), tuple(types)), values


@lru_cache(maxsize=4096)
def _shape(names: tuple[str, ...], types: tuple[str, ...]) -> RowShape:
    """One object for all runs with the same columns."""
    return RowShape(tuple(map(today, names)), summary_kinds(names, types))


def _parse_status(data: bytes) -> tuple[RowShape, Sequence[Any]]:
    record = parse_json(data)
    check_status(record)
    state, step = record.get("state"), record.get("step")
    return _STATUS_SHAPE, (
        state if state in STATES else None,
        step,
        unix_time(record.get("created")),
        unix_time(record.get("heartbeat")),
        _text(record.get("error")),
        json.dumps(record) if state == "running" else None,
    )


def _parse_annotations(data: bytes) -> tuple[RowShape, Sequence[Any]]:
    record = _object(data)
    return _ANNOTATIONS_SHAPE, (json.dumps(_tags(record)), _text(record.get("note")))


def _tags(record: Mapping[str, Any]) -> list[str]:
    tags = record.get("tags")
    return sorted({tag for tag in tags if isinstance(tag, str)}) if isinstance(tags, list) else []


def _object(data: bytes) -> dict[str, Any]:
    try:
        return parse_json(data)
    except ValueError:
        return {}


def _text(value: Any) -> str | None:
    """Text that Arrow accepts: JSON may contain halves of characters."""
    return value.encode(errors="replace").decode() if isinstance(value, str) and value else None


_PARSERS: dict[str, Callable[[bytes], tuple[RowShape, Sequence[Any]]]] = {
    SUMMARY: _parse_summary,
    STATUS: _parse_status,
    ANNOTATIONS: _parse_annotations,
}
