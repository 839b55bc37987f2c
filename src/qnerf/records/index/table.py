"""One table of all runs of a store. It reads only the files that changed since the last time.

A run's row comes from three files: summary.parquet, status.json and annotations.json. For each of the three, the index
keeps what it read from every run, together with the stamp that the file had just before it was read: modification time,
change time, size and inode, or the entity tag of an object store. A file is read again unless its stamp is still the
same. So an entry may be missing or old, but it is never used for another version of the file:

- Files of a run are replaced, not changed. The next version has another inode and other times.
- A file that changed in the last `locations.SETTLED` seconds gets no stamp and is read every time, because a coarse
  clock could give the next version the same time.
- Stamps are taken before reading. A version that arrives in between has the older stamp, and is read again.
- Nobody can set a change time. An older copy that is put back with its modification time has another stamp.
- Whether a run that says "running" is alive is not stored. It is found out every time.
- Status is read before the summary, so the row of a finished run is complete.
- The index is replaced whole and begins with its checksum. A damaged one, or one in another format, is ignored.

Several processes may refresh the index at once. Each writes a correct one, and the last one stays. If the store cannot
be written, the index lies in the user's cache folder; if that cannot be written either, there is none.
"""

import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa

from qnerf.records.files import StoreError
from qnerf.records.index import entries
from qnerf.records.index.index_file import StoredIndex, save
from qnerf.records.index.locations import ANNOTATIONS, STATUS, SUMMARY, UNSETTLED, FolderLocation, Location, Stamps
from qnerf.records.index.ragged_rows import RaggedRow, RaggedTable
from qnerf.records.location import existing_store, url_protocol
from qnerf.records.parquet import reading

Progress = Callable[[str, int, int], None]
"""Called with a file's name, how many of them were read, and how many there are to read."""

RUN_COLUMNS = ("run_id", "state", "error", "path", "step", "created", "heartbeat", "tags", "note")
"""Columns that do not come from the summary, even if it has values with these names."""

CHANGES_WORTH_SAVING = 0.01  # share of the entries; below it, reading them again takes less time than writing the index


def load(store: str | Path, columns: Sequence[str] | None = None, *, progress: Progress | None = None) -> pd.DataFrame:
    """One row per run, sorted by `run_id`. The columns are those of summary.parquet (results, parameter counts,
    timings, the flat configuration) and:

    state: running | finished | interrupted | failed, or damaged if summary.parquet or status.json cannot be read.
    error: why the run failed, or what is damaged. path: the run's folder or URL. step: the last one
    logged. created, heartbeat: Unix times. tags: a tuple. note: text.

    A column with numbers in some runs and text in others is text.

    store: a folder, or a URL that fsspec can read; an absent or empty one gives no rows. columns: only these, which is
    faster; names that no run has are left out. progress: see `Progress`.

    Raises:
        ValueError: the store cannot be read.
    """
    location = locate(store)
    stamps = location.scan()
    # A run writes its summary before its last state. If the state has changed, the summary is read after it.
    status, changed = _refreshed(location, STATUS, stamps, progress)
    summary_values = None if columns is None else [*columns, "error", entries.DAMAGED]
    summary, _ = _refreshed(location, SUMMARY, stamps, progress, names=summary_values, reread=changed)
    annotations, _ = _refreshed(location, ANNOTATIONS, stamps, progress)
    removed = _stamps_of(SUMMARY, stamps).keys() - set(summary.keys())  # while they were read
    runs = [run for run in stamps if run not in removed]
    tables = (summary.reindexed(runs), status.reindexed(runs), annotations.reindexed(runs))
    return _frame(location, runs, *tables, columns)


def load_runs(location: Location, runs: Sequence[str]) -> pd.DataFrame:
    """The rows of `load` for these runs alone, read anew and kept nowhere: for a reader that knows which ones changed.

    runs: names from `Location.scan`.
    """
    stamps = dict.fromkeys(sorted(runs), UNSETTLED)
    tables = {file: entries.table(list(_read(location, file, stamps, None))) for file in (STATUS, SUMMARY, ANNOTATIONS)}
    rows = {file: table.reindexed(stamps) for file, table in tables.items()}
    return _frame(location, list(stamps), rows[SUMMARY], rows[STATUS], rows[ANNOTATIONS], None)


def columns(store: str | Path) -> list[str]:
    """Names of all columns of `load`."""
    return list(load(store).columns)


def locate(store: str | Path) -> Location:
    """The location of a store or a run: a folder, a file:// URL, or another URL. ValueError if it cannot be read."""
    if url_protocol(store) is None:
        return FolderLocation(existing_store(store))
    from qnerf.records.index.remote import UrlLocation  # importing fsspec takes longer than listing a small store

    return UrlLocation(str(store))


def _stamps_of(file: str, stamps: Stamps) -> dict[str, str]:
    return {run: files[file] for run, files in stamps.items() if file in files}


def _refreshed(
    location: Location,
    file: str,
    all_stamps: Stamps,
    progress: Progress | None,
    *,
    names: Sequence[str] | None = None,
    reread: Collection[str] = (),
) -> tuple[RaggedTable, Collection[str]]:
    """The entries of one file of every run, sorted by run, and the runs whose file was read.

    names: the result has at least these values. reread: runs whose file is read in any case.
    """
    folders, name = location.index_folders(), f"{file}.index"
    stored = StoredIndex.load(folders, name, partial(entries.check_shape, file))
    stamps = _stamps_of(file, all_stamps)

    def current_entries() -> RaggedTable:
        current = [
            number
            for number, (run, stamp) in enumerate(zip(stored.keys, stored.stamps, strict=True))
            if stamps.get(run) == stamp != UNSETTLED and run not in reread
        ]
        table = stored.entries(names if len(current) == len(stamps) else None).take(current)
        with reading(name):
            entries.check(file, table)
        return table

    try:
        table = current_entries()
    except StoreError:  # damaged, or written by somebody else
        stored = StoredIndex()
        table = current_entries()
    current = table.keys()
    if len(current) == len(stamps):
        return table, ()
    stale = stamps.keys() - set(current)
    fresh = list(_read(location, file, {run: stamps[run] for run in sorted(stale)}, progress))
    table = (table + entries.table(fresh)).sorted()
    changes = len(stale) + len(stored.keys) - len(current)
    if changes > CHANGES_WORTH_SAVING * len(stamps):
        save(table, folders, name)
    return table, stale


def _read(location: Location, file: str, stamps: Mapping[str, str], progress: Progress | None) -> Iterator[RaggedRow]:
    for number, (run, data) in enumerate(zip(stamps, location.read(file, list(stamps)), strict=True)):
        if progress is not None:
            progress(file, number, len(stamps))
        if isinstance(data, StoreError):
            yield entries.unreadable(run, UNSETTLED, str(data))
        elif data is not None:
            yield entries.parse(file, run, stamps[run], data)


def _frame(
    location: Location,
    runs: Sequence[str],
    summary: RaggedTable,
    status: RaggedTable,
    annotations: RaggedTable,
    columns: Sequence[str] | None,
) -> pd.DataFrame:
    """The three tables have one row for each of `runs`, in this order."""
    reasons = zip(summary.values(entries.DAMAGED), status.values(entries.DAMAGED), strict=True)
    damage = [next(filter(None, each), None) for each in reasons]
    errors = zip(damage, status.values("error"), summary.values("error"), strict=True)
    run_columns = {
        "run_id": pa.array(runs, pa.string()),
        "state": pa.array(_states(location, runs, damage, status), pa.string()),
        "error": pa.array([next(filter(None, each), None) for each in errors], pa.string()),
        "path": pa.array([location.path(run) for run in runs], pa.string()),
        "step": pa.array(status.values("step"), pa.int64()),
        "created": pa.array(status.values("created"), pa.float64()),
        "heartbeat": pa.array(status.values("heartbeat"), pa.float64()),
        "note": pa.array(annotations.values("note"), pa.string()),
    }
    leading = {name: run_columns[name] for name in ("run_id", "state", "error")}
    results = summary.columns(columns)
    results.pop(entries.DAMAGED, None)
    frame = pa.table(leading | results | run_columns).to_pandas()
    frame["tags"] = pd.Series([tuple(json.loads(tags or "[]")) for tags in annotations.values("tags")], dtype=object)
    return frame if columns is None else frame[[name for name in columns if name in frame.columns]]


def _states(location: Location, runs: Sequence[str], damage: Sequence[Any], status: RaggedTable) -> list[str]:
    rows = zip(runs, damage, status.values("state"), status.values("record"), strict=True)
    return [
        "damaged" if reason else location.state(run, json.loads(record)) if record else state or "interrupted"
        for run, reason, state, record in rows
    ]
