"""One table of all runs of a store. It reads only the runs that changed since the last time.

A run's row comes from its summary.parquet, status.json, annotations.json and a check of config.yaml. The index on disk,
`.index/runs-2.parquet`, holds the rows and a stamp of the files from which each was read: modification time,
change time, size and inode. A run is read again unless its stamp is still the same. Stamps are taken before reading. A
file that changed in the last `SETTLED` seconds gives no stamp, because a coarse clock could give the next version the
same time. Whether a run that says "running" is alive is found out every time.

Several processes may refresh the index at once. Each writes a correct one, and the last one stays. A store that cannot
be written has no index: all runs are read each time.
"""

import contextlib
import json
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from qnerf.records import annotations, read
from qnerf.records.files import StoreError, refuse_links, replace, reporting
from qnerf.records.location import existing_store
from qnerf.records.owner import unix_time
from qnerf.records.parquet import TYPES, encode, kind_of, read_table

Progress = Callable[[str, int, int], None]
"""Called with what is read, how many of them were read, and how many there are to read."""

RUN_COLUMNS = {
    "run_id": "text", "state": "text", "error": "text", "path": "text", "step": "int", "created": "float",
    "heartbeat": "float", "tags": "text", "note": "text",
}  # fmt: skip
"""Columns that do not come from the summary, even if it has values with these names."""

FILES = ("summary.parquet", "status.json", "config.yaml", "annotations.json")
INDEX = Path(".index", "runs-2.parquet")  # below a store; the number is that of the format
SETTLED = 10.0  # seconds; file systems count in steps of up to 2 s, and the clock of a server may be a little behind
UNSETTLED = ""
"""Stamp of a run that changed more recently; it equals no stamp."""

_STAMP = ".stamp"
_BATCH = 500  # rows that become a table at once
_CHANGES_WORTH_SAVING = 0.01  # share of the runs; below it, reading them again takes less time than writing the index

Stamps = dict[str, str]
"""Run -> stamp of its files."""


def load(store: str | Path, columns: Sequence[str] | None = None, *, progress: Progress | None = None) -> pd.DataFrame:
    """One row per run, sorted by `run_id`. The columns are the union of those of summary.parquet (results, parameter
    counts, timings, the flat configuration), empty for runs that lack them, and:

    state: running | finished | interrupted | failed, or damaged if summary.parquet, status.json or config.yaml cannot
    be read, or the folder is a copy of another run. error: why the run failed, or what is damaged. path: the run's
    folder. step: the last one logged. created, heartbeat: Unix times. tags: a tuple. note: text.

    A column with numbers in some runs and text in others is text.

    store: a folder; an empty one gives no rows. columns: only these; names that no run has are left out. progress: see
    `Progress`.

    Raises:
        ValueError: the store cannot be read.
    """
    root = existing_store(store)
    stamps = scan(root)
    stored = _stored(root)
    current = [
        row
        for row, (run, stamp) in enumerate(zip(*(stored[name].to_pylist() for name in ("run_id", _STAMP)), strict=True))
        if stamps.get(run) == stamp != UNSETTLED
    ]
    kept = stored.take(pa.array(current, pa.int64()))
    stale = sorted(stamps.keys() - set(kept["run_id"].to_pylist()))
    table = _joined([kept, *_read(root, {run: stamps[run] for run in stale}, progress)]).sort_by("run_id")
    if len(stale) + len(stored) - len(kept) > _CHANGES_WORTH_SAVING * len(stamps):
        _save(root, table)
    return _frame(root, table, columns)


def load_runs(store: str | Path, runs: Iterable[str]) -> pd.DataFrame:
    """The rows of `load` for these runs alone, read anew: for a reader that knows which ones changed."""
    root = Path(store)
    return _frame(root, _joined([*_read(root, dict.fromkeys(sorted(runs), UNSETTLED), None)]), None)


def scan(root: Path) -> Stamps:
    """The stamps of all runs of a store, sorted by name; empty if there is no store yet."""
    with reporting(root, "read"):
        try:
            names = sorted(name for name in os.listdir(root) if not name.startswith(".") and _is_unicode(name))
        except (FileNotFoundError, NotADirectoryError):
            return {}
    settled = time.time() - SETTLED
    stamps = {name: _stamp(f"{root}/{name}", settled) for name in names}
    return {name: stamp for name, stamp in stamps.items() if stamp is not None}


def _stamp(folder: str, settled: float) -> str | None:
    """None if the folder is not a run."""
    parts = []
    for file in FILES:
        try:
            status = os.stat(f"{folder}/{file}")
        except (FileNotFoundError, NotADirectoryError):
            continue
        except OSError:  # the reason is reported when the file is read
            return UNSETTLED
        if max(status.st_mtime, status.st_ctime) >= settled:
            return UNSETTLED
        parts.append(f"{status.st_mtime_ns} {status.st_ctime_ns} {status.st_size} {status.st_ino}")
    if not parts and not any(os.path.lexists(f"{folder}/{file}") for file in read.RUN_MARKERS):
        return None
    return "; ".join(parts)


def _is_unicode(name: str) -> bool:
    """False for names in another encoding, which no table can hold; qnerf's own names are ASCII."""
    return not any("\ud800" <= character <= "\udfff" for character in name)


def _read(root: Path, stamps: Mapping[str, str], progress: Progress | None) -> Iterable[pa.Table]:
    """Tables of up to `_BATCH` rows, a row a run; without the runs that are gone."""
    rows: list[pa.Table] = []
    for number, (run, stamp) in enumerate(stamps.items()):
        if progress is not None:
            progress("runs", number, len(stamps))
        row = _row(root / run)
        if row is not None:
            rows.append(row.append_column(_STAMP, pa.array([stamp])))
        if len(rows) == _BATCH:
            yield _joined(rows)
            rows = []
    if rows:
        yield _joined(rows)


def _row(folder: Path) -> pa.Table | None:
    """The row of a run; None if its folder is gone."""
    values: dict[str, Any] = {"run_id": folder.name, "tags": "[]"}
    summary = pa.table({})
    try:
        # A run writes its summary before its last state: a summary read after the state is complete.
        values |= _status(folder / "status.json")
        if (folder / "summary.parquet").exists():
            summary = read.read_summary_table(folder)
        if (folder / "config.yaml").exists():
            read.check_config(folder)
    except (OSError, StoreError) as error:
        values |= {"state": "damaged", "error": str(error)}
    if not folder.is_dir():
        return None
    with contextlib.suppress(StoreError):
        annotated = annotations.read(folder)
        values |= {"tags": json.dumps(annotated.tags), "note": annotated.note or None}
    values["error"] = values.get("error") or (summary["error"][0].as_py() if "error" in summary.schema.names else None)
    own = {name: _cell(values.get(name), kind) for name, kind in RUN_COLUMNS.items() if name != "path"}
    others = {name: summary[name] for name in summary.schema.names if name not in RUN_COLUMNS and name != _STAMP}
    leading = {name: own.pop(name) for name in ("run_id", "state", "error")}
    return pa.table({**leading, **others, **own})


def _status(path: Path) -> dict[str, Any]:
    """Values from a run's status.json; an absent one is a run that was interrupted."""
    try:
        record = read.checked_status(path)
    except StoreError as error:
        if isinstance(error.__cause__, FileNotFoundError):
            return {"state": "interrupted"}
        raise
    values = {name: unix_time(record.get(name)) for name in ("created", "heartbeat")}
    state = record.get("state")
    return {
        **values,
        "state": state if state in read.STATES else "interrupted",
        "step": record.get("step"),
        "error": record.get("error"),
    }


def _cell(value: Any, kind: str) -> pa.Array:
    if isinstance(value, str):  # JSON may contain halves of characters
        value = value.encode(errors="replace").decode()
    return pa.array([value], TYPES[kind])


def _joined(tables: Sequence[pa.Table]) -> pa.Table:
    """The rows of all tables, with all their columns. Columns of different kinds become float64 or text."""
    groups: dict[pa.Schema, list[pa.Table]] = {}
    for table in tables:
        groups.setdefault(table.schema, []).append(table)
    kinds: dict[str, set[str]] = {name: {"text"} for name in ("run_id", _STAMP)}
    for schema in groups:
        for field in schema:
            kinds[field.name] = kinds.get(field.name, set()) | {kind_of(field.type)}
    types = {name: _common(found - {"none"}) for name, found in kinds.items()}
    parts = [pa.schema(list(types.items())).empty_table()]
    for schema, group in groups.items():
        target = pa.schema([(name, types[name]) for name in schema.names])
        parts.append(pa.concat_tables(group).cast(target, safe=False))
    return pa.concat_tables(parts, promote_options="default").combine_chunks()


def _common(kinds: set[str]) -> pa.DataType:
    if not kinds:
        return pa.null()
    if len(kinds) > 1:
        return TYPES["float" if kinds == {"int", "float"} else "text"]
    return TYPES[next(iter(kinds))]


def _frame(root: Path, table: pa.Table, columns: Sequence[str] | None) -> pd.DataFrame:
    names = table["run_id"].to_pylist()
    paths = [os.path.join(root, name) for name in names]
    stored = table["state"].to_pylist() if "state" in table.schema.names else []
    states = [_true_state(path) if state == "running" else state for path, state in zip(paths, stored, strict=True)]
    frame = table.drop_columns([_STAMP]).to_pandas()
    own = {"state": states, "path": paths, "tags": [tuple(json.loads(tags)) for tags in frame.get("tags", [])]}
    for name, values in own.items():
        frame[name] = pd.Series(values, index=frame.index, dtype=object)
    for name in RUN_COLUMNS:  # an empty store has them, too
        if name not in frame:
            frame[name] = pd.Series(dtype=object)
    return frame if columns is None else frame[[name for name in columns if name in frame.columns]]


def _true_state(path: str) -> str:
    """Of a run whose row says running. One that has ended since it was read is shown as it was then."""
    now = read.state(path)
    return now if now == "interrupted" else "running"


def _stored(root: Path) -> pa.Table:
    """The index on disk; empty if there is no undamaged one."""
    with contextlib.suppress(StoreError):
        table = read_table(root / INDEX)
        if {_STAMP, *RUN_COLUMNS} - {"path"} <= set(table.schema.names):
            return table
    return pa.table({"run_id": pa.array([], pa.string()), _STAMP: pa.array([], pa.string())})


def _save(root: Path, table: pa.Table) -> None:
    """Writes the index, if it can be written, without the runs that are read again in any case."""
    settled = table.filter(pc.and_(pc.not_equal(table[_STAMP], UNSETTLED), pc.not_equal(table["state"], "damaged")))
    file = root / INDEX
    with contextlib.suppress(OSError, StoreError):
        refuse_links(file.parent)
        file.parent.mkdir(exist_ok=True)
        replace(file, encode(settled), durable=False)
