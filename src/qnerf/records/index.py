"""One table of all runs of a store. It reads only the runs that changed since the last time.

A run's row comes from its summary.parquet, status.json, annotations.json and a check of config.yaml. The index on disk,
`.index/runs.json`, holds for each run a stamp of the files from which it was read (modification time, change time, size
and inode) and its row. A run is read again unless its stamp is still the same. Stamps are taken before reading. A file
that changed in the last `SETTLED` seconds gives no stamp, because a coarse clock could give the next version the same
time. Whether a run that says "running" is alive is found out every time.

Several processes may refresh the index at once. Each writes a correct one, and the last one stays. A store that cannot
be written has no index: all runs are read each time.
"""

import contextlib
import json
import os
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from pandas.api.types import infer_dtype

from qnerf.records import annotations, read
from qnerf.records.files import (
    MAX_TABLE_BYTES,
    StoreError,
    parse_json,
    read_bytes,
    refuse_links,
    replace,
    reporting,
)
from qnerf.records.location import existing_store
from qnerf.records.owner import unix_time
from qnerf.records.schemas import known_kind

RUN_COLUMNS = ("run_id", "state", "error", "path", "step", "created", "heartbeat", "tags", "note")
"""Columns that do not come from the summary, even if it has values with these names."""

FILES = ("summary.parquet", "status.json", "config.yaml", "annotations.json")
INDEX = Path(".index", "runs.json")  # below a store
SETTLED = 10.0  # seconds; file systems count in steps of up to 2 s, and the clock of a server may be a little behind
UNSETTLED = ""
"""Stamp of a run that changed more recently; it equals no stamp."""

_CHANGES_WORTH_SAVING = 0.01  # share of the runs; below it, reading them again takes less time than writing the index

Row = dict[str, Any]
Stamps = dict[str, str]
"""Run -> stamp of its files."""


def load(store: str | Path, columns: Sequence[str] | None = None) -> pd.DataFrame:
    """One row per run, sorted by `run_id`. The columns are the union of those of summary.parquet (results, parameter
    counts, timings, the flat configuration), empty for runs that lack them, and:

    state: running | finished | interrupted | failed, or damaged if summary.parquet, status.json or config.yaml cannot
    be read, or the folder is a copy of another run. error: why the run failed, or what is damaged. path: the run's
    folder. step: the last one logged. created, heartbeat: Unix times. tags: a tuple. note: text.

    A column with numbers in some runs and text in others is text.

    store: a folder; an empty one gives no rows. columns: only these; names that no run has are left out.

    Raises:
        ValueError: the store cannot be read.
    """
    root = existing_store(store)
    stamps = scan(root)
    stored = _stored(root)
    kept = {run for run, stamp in stamps.items() if run in stored and stored[run][0] == stamp != UNSETTLED}
    found = {run: stored[run][1] if run in kept else _row(root / run) for run in stamps}
    rows = {run: row for run, row in found.items() if row is not None}
    if len(stamps) + len(stored) - 2 * len(kept) > _CHANGES_WORTH_SAVING * len(stamps):
        _save(root, {run: (stamps[run], row) for run, row in rows.items()})
    return _frame(root, list(rows.values()), columns)


def load_runs(store: str | Path, runs: Iterable[str]) -> pd.DataFrame:
    """The rows of `load` for these runs alone, read anew: for a reader that knows which ones changed."""
    root = Path(store)
    return _frame(root, [row for run in sorted(runs) if (row := _row(root / run)) is not None], None)


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


def _row(folder: Path) -> Row | None:
    """The row of a run; None if its folder is gone."""
    values: Row = {}
    summary: Row = {}
    try:
        # A run writes its summary before its last state: a summary read after the state is complete.
        values |= _status(folder / "status.json")
        if (folder / "summary.parquet").exists():
            summary = read.read_summary(folder)
        if (folder / "config.yaml").exists():
            read.check_config(folder)
    except (OSError, StoreError) as error:
        values |= {"state": "damaged", "error": str(error)}
    if not folder.is_dir():
        return None
    with contextlib.suppress(StoreError):
        annotated = annotations.read(folder)
        values |= {"tags": annotated.tags, "note": annotated.note or None}
    values |= {"run_id": folder.name, "error": values.get("error") or summary.get("error")}
    others = {name: value for name, value in summary.items() if name not in RUN_COLUMNS}
    return {name: _encodable(values.get(name)) for name in RUN_COLUMNS} | others


def _encodable(value: Any) -> Any:
    """The value; of a text what UTF-8 can hold, because JSON may contain halves of characters."""
    return value.encode(errors="replace").decode() if isinstance(value, str) else value


def _status(path: Path) -> dict[str, Any]:
    """Values from a run's status.json; an absent one is a run that was interrupted."""
    try:
        record = read.checked_status(path)
    except StoreError as error:
        if isinstance(error.__cause__, FileNotFoundError):
            return {"state": "interrupted"}
        raise
    state, step, why = (record.get(name) for name in ("state", "step", "error"))
    return {
        **{name: unix_time(record.get(name)) for name in ("created", "heartbeat")},
        "state": state if state in read.STATES else "interrupted",
        "step": step if isinstance(step, int) else None,
        "error": None if why is None else str(why),
    }


def _frame(root: Path, rows: Sequence[Row], columns: Sequence[str] | None) -> pd.DataFrame:
    """A table of the rows. A column with text in some runs and other values in others is text."""
    names = dict.fromkeys([*RUN_COLUMNS, *(name for row in rows for name in row)])
    frame = pd.DataFrame({name: [row.get(name) for row in rows] for name in names})
    for name, column in frame.items():
        if infer_dtype(column, skipna=True).startswith("mixed"):
            frame[name] = [value if value is None or isinstance(value, str) else json.dumps(value) for value in column]
        elif known_kind(str(name)) in ("int", "float") and column.isna().all():
            frame[name] = column.astype(float)
    paths = [os.path.join(root, row["run_id"]) for row in rows]
    stored = [row["state"] for row in rows]
    states = [_true_state(path) if state == "running" else state for path, state in zip(paths, stored, strict=True)]
    own = {"state": states, "path": paths, "tags": [tuple(row["tags"] or ()) for row in rows]}
    for name, values in own.items():
        frame[name] = pd.Series(values, index=frame.index, dtype=object)
    return frame if columns is None else frame[[name for name in columns if name in frame.columns]]


def _true_state(path: str) -> str:
    """Of a run whose row says running. One that has ended since it was read is shown as it was then."""
    now = read.state(path)
    return now if now == "interrupted" else "running"


def _stored(root: Path) -> dict[str, tuple[str, Row]]:
    """Run -> stamp and row, from the index on disk; empty if there is no undamaged one."""
    with contextlib.suppress(OSError, ValueError, TypeError):
        stored = parse_json(read_bytes(root / INDEX, MAX_TABLE_BYTES))
        return {run: (str(stamp), {**row}) for run, (stamp, row) in stored.items()}
    return {}


def _save(root: Path, rows: Mapping[str, tuple[str, Row]]) -> None:
    """Writes the index, if it can be written, without the runs that are read again in any case."""
    settled = {run: own for run, own in rows.items() if own[0] != UNSETTLED and own[1]["state"] != "damaged"}
    file = root / INDEX
    with contextlib.suppress(OSError, StoreError):
        refuse_links(file.parent)
        file.parent.mkdir(exist_ok=True)
        replace(file, json.dumps(settled).encode(), durable=False)
