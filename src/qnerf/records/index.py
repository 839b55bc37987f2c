"""One table of all runs of a store. It reads only the runs that changed since the last time.

A run's row comes from its summary.parquet and status.json. The index on disk, `.index/runs.json`, holds for each run a
stamp of its files (modification time, size and inode) and its row. A run is read again unless its stamp is still the
same. Stamps are taken before reading. Whether a run that says "running" is alive is found out every time.

Several processes may refresh the index at once. Each writes a correct one, and the last one stays. A store that cannot
be written has no index: all runs are read each time.
"""

import contextlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from pandas.api.types import infer_dtype

from qnerf.config.identity import is_unicode
from qnerf.records import read
from qnerf.records.files import StoreError, read_json, replace
from qnerf.records.location import existing_store
from qnerf.records.schemas import RUN_COLUMNS, known_kind

INDEX = Path(".index", "runs.json")  # below a store
NO_SCENE = "none"
"""The name of the scene of tracked runs that name none."""

_CHANGES_WORTH_SAVING = 0.01  # share of the runs; below it, reading them again takes less time than writing the index

Row = dict[str, Any]
Stamps = dict[str, str]
"""Run -> stamp of its files."""


def load(store: str | Path, columns: Sequence[str] | None = None) -> pd.DataFrame:
    """One row per run, sorted by `run_id`. The columns are the union of those of summary.parquet (results, parameter
    counts, timings, the flat configuration), empty for runs that lack them, and:

    state: running | finished | interrupted | failed, or damaged if summary.parquet or status.json cannot be
    read, or the folder is a copy of another run. error: why the run failed, or what is damaged. path: the run's
    folder. scene_name: the last part of scene.path, or the scene's name, or "none". step: the last one logged.
    created, heartbeat: Unix times.

    A column with numbers in some runs and text in others is text.

    store: a folder; an empty one gives no rows. columns: only these; names that no run has are left out.

    Raises:
        ValueError: the store cannot be read.
    """
    root = existing_store(store)
    stamps = scan(root)
    stored = _stored(root)
    kept = {run: stored[run][1] for run, stamp in stamps.items() if run in stored and stored[run][0] == stamp}
    found = {run: kept.get(run) or _row(root / run) for run in stamps}
    rows = {run: row for run, row in found.items() if row is not None}
    if len(stamps) - len(kept) > _CHANGES_WORTH_SAVING * len(stamps):
        _save(root, {run: (stamps[run], row) for run, row in rows.items()})
    return _frame(root, list(rows.values()), columns)


def scan(root: Path) -> Stamps:
    """The stamps of all runs of a store, sorted by name; empty if there is no store yet."""
    stamps = {folder.name: _stamp(str(folder)) for folder in read.runs(root)}
    return {name: stamp for name, stamp in stamps.items() if stamp}


def _stamp(folder: str) -> str:
    """Empty if the folder is not a run."""
    parts = []
    for file in read.RUN_MARKERS:
        try:
            status = os.stat(f"{folder}{os.sep}{file}")
        except FileNotFoundError:
            continue
        except OSError:  # the reason is reported when the file is read
            parts.append(f"{file} cannot be read")
        else:
            parts.append(f"{file} {status.st_mtime_ns} {status.st_size} {status.st_ino}")
    return "; ".join(parts)


def _row(folder: Path) -> Row | None:
    """The row of a run; None if its folder is gone."""
    status: dict[str, Any] = {}
    summary: Row = {}
    damage = None
    try:
        # A run writes its summary before its last state: a summary read after the state is complete.
        if (folder / "status.json").exists():
            status = read.checked_status(folder)
        if (folder / "summary.parquet").exists():
            summary = read.read_summary(folder)
    except StoreError as error:
        damage = str(error)
    if not folder.is_dir():
        return None
    stored = status.get("state")
    name = folder.name.encode(errors="backslashreplace").decode()
    damage = damage if is_unicode(folder.name) else f"{name}: expected a folder whose name is UTF-8; rename it"
    own = {
        "run_id": name,
        "state": "damaged" if damage else stored if stored in ("running", *read.ENDED) else "interrupted",
        "error": damage or status.get("error") or summary.get("error"),
        "path": None,  # the store may be moved
        **{name: status.get(name) for name in ("step", "created", "heartbeat")},
    }
    return summary | own


def _frame(root: Path, rows: Sequence[Row], columns: Sequence[str] | None) -> pd.DataFrame:
    """A table of the rows. A column with text in some runs and other values in others is text."""
    known = dict.fromkeys([*RUN_COLUMNS, *(name for row in rows for name in row)])
    names = [name for name in known if columns is None or name in columns]
    frame = pd.DataFrame({name: [row.get(name) for row in rows] for name in names})
    for name, column in frame.items():
        if infer_dtype(column, skipna=True).startswith("mixed"):
            frame[name] = [value if value is None or isinstance(value, str) else json.dumps(value) for value in column]
        elif known_kind(str(name)) in ("int", "float") and column.isna().all():
            frame[name] = column.astype(float)
    own = {
        "state": lambda row: _true_state(root / row["run_id"], row["state"]),
        "path": lambda row: str(root / row["run_id"]),
    }
    for name in own.keys() & names:
        frame[name] = pd.Series(list(map(own[name], rows)), index=frame.index, dtype=object)
    if columns is None or "scene_name" in columns:
        frame["scene_name"] = pd.Series(list(map(_scene_name, rows)), index=frame.index, dtype=object)
    return frame if columns is None else frame[[name for name in columns if name in frame.columns]]


def _scene_name(row: Row) -> str | None:
    path = row.get("scene.path")
    name = Path(path).name if isinstance(path, str) and path else row.get("scene")
    return NO_SCENE if name is None and row["state"] != "damaged" else name


def _true_state(folder: Path, stored: str) -> str:
    """Interrupted if the run's process is dead. A run that has ended since it was read is shown as it was then."""
    return "interrupted" if stored == "running" and read.state(folder) == "interrupted" else stored


def _stored(root: Path) -> dict[str, tuple[str, Row]]:
    """Run -> stamp and row, from the index on disk; empty if there is no undamaged one."""
    with contextlib.suppress(OSError, ValueError, TypeError):
        return {run: (stamp, {**row}) for run, (stamp, row) in read_json(root / INDEX).items()}
    return {}


def _save(root: Path, rows: Mapping[str, tuple[str, Row]]) -> None:
    """Writes the index, if it can be written. What is damaged is read again: it may have been a broken disk."""
    kept = {run: own for run, own in rows.items() if own[1]["state"] != "damaged"}
    with contextlib.suppress(OSError, StoreError):
        (root / INDEX).parent.mkdir(exist_ok=True)
        replace(root / INDEX, json.dumps(kept).encode(), durable=False)
