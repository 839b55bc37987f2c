"""One table of all runs of a store, which reads only what changed since it was last asked for.

Three files of a run make its row: summary.parquet, status.json and annotations.json. What was read of them is kept in
the index, a file for each of the three, beside the stamp that the run's file had just before it was read: times of
modification and change, size and inode, or the entity tag of an object store. A run's file is read again unless its
stamp is the kept one, so an entry may be missing or old, but is never taken for that of another version:

- A run's files are replaced, not changed: the next version has another inode, and other times.
- A file that changed within `places.SETTLED` seconds before the look has no stamp, so that a version which follows
  within the clock's granularity is not missed. It is read every time until it has settled.
- Stamps are taken before reading. A version that comes in between is kept under the older stamp, and read again.
- Nobody can set a change time: putting back an older copy with its times does not bring back its stamp.
- Whether a run that says "running" is alive is never kept; it is found out at every look.
- A row never tells of an end that its numbers do not include: a summary is read after the state that stands beside it.
- The index is replaced whole and begins with its checksum; a damaged one, or one of another format, counts as none.

Whoever refreshes at the same time writes an index that is right as well; the last one stays. Where the store cannot be
written the index lies in the user's cache folder, and where that cannot be written, nowhere.
"""

import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa

from qnerf.records.files import StoreError
from qnerf.records.index import entries
from qnerf.records.index.index_file import Kept, save
from qnerf.records.index.locations import ANNOTATIONS, STATUS, SUMMARY, UNSETTLED, Folder, Place, Stamps
from qnerf.records.index.ragged_rows import Row, Rows

Progress = Callable[[str, int, int], None]
"""Called with a file's name, how many of them were read, and how many there are to read."""

OWN = ("run_id", "state", "error", "path", "step", "created", "heartbeat", "tags", "note")
"""Columns that do not come from the summary, whatever it has under these names."""

WORTH = 100  # the index is written when more than one in so many entries changed: reading fewer takes less than that


def load(store: str | Path, columns: Sequence[str] | None = None, *, progress: Progress | None = None) -> pd.DataFrame:
    """One row a run, sorted by `run_id`: the columns of summary.parquet (results, parameter counts, timings, the flat
    configuration), and

    state: the true one, running | finished | interrupted | failed, or damaged where summary.parquet cannot be read.
    error: why the run failed, or what is wrong with its summary. path: the run's folder or URL. step: the last one
    logged. created, heartbeat: Unix times. tags: a tuple. note: text.

    A column that holds numbers in some runs and text in others is text.

    store: a folder, or a URL that fsspec can read; an absent or empty one has no rows. columns: these only, which is
    faster; those that no run has are left out. progress: see `Progress`.

    Raises:
        ValueError: the store cannot be read.
    """
    place = place_of(store)
    found = place.scan()
    # A run writes its summary before the state that it ends with: whose state is new, its summary is read after it.
    status, new = _refreshed(place, STATUS, found, progress)
    summary, _ = _refreshed(place, SUMMARY, found, progress, names=_needed(columns), again=new)
    annotations, _ = _refreshed(place, ANNOTATIONS, found, progress)
    parts = {SUMMARY: summary, STATUS: status, ANNOTATIONS: annotations}
    removed = _stamps(found, SUMMARY).keys() - set(parts[SUMMARY].keys())  # while they were read
    runs = [run for run in found if run not in removed]
    return _frame(place, runs, {file: _Aligned(rows, runs) for file, rows in parts.items()}, columns)


def columns(store: str | Path) -> list[str]:
    """Names of the columns that `load` gives without `columns`."""
    return list(load(store).columns)


def place_of(store: str | Path) -> Place:
    """Where the store lies: file:// is this machine, too. Raises ValueError where a URL cannot be read."""
    protocol, separator, rest = str(store).partition("://")
    if not separator or protocol == "file":
        return Folder(rest if separator else store)
    from qnerf.records.index.remote import Remote  # fsspec takes longer to import than a small store to list

    return Remote(str(store))


def _stamps(found: Stamps, file: str) -> dict[str, str]:
    return {run: files[file] for run, files in found.items() if file in files}


def _needed(columns: Sequence[str] | None) -> Sequence[str] | None:
    """Values of summaries that the columns are made of; None: all."""
    return None if columns is None else [*columns, "error", entries.DAMAGED]


def _refreshed(
    place: Place,
    file: str,
    found: Stamps,
    progress: Progress | None,
    *,
    names: Sequence[str] | None = None,
    again: Collection[str] = (),
) -> tuple[Rows, Collection[str]]:
    """The entries of that file, sorted by run, with at least the named values; and the runs of which it was read.

    again: runs of which it is read in any case.
    """
    folders, name = place.index_folders(), f"{file}.index"
    kept = Kept.load(folders, name)
    stamps = _stamps(found, file)
    current = [
        number
        for number, (run, stamp) in enumerate(zip(kept.keys, kept.stamps, strict=True))
        if stamps.get(run) == stamp != UNSETTLED and run not in again
    ]
    if len(current) == len(stamps):
        return kept.rows(names).take(current), ()
    stale = stamps.keys() - {kept.keys[number] for number in current}
    read = list(_read(place, file, {run: stamps[run] for run in sorted(stale)}, progress))
    rows = (kept.rows().take(current) + entries.rows(read)).sorted()
    if (len(stale) + len(kept.keys) - len(current)) * WORTH > len(stamps):
        save(rows, folders, name)
    return rows, stale


def _read(place: Place, file: str, stamps: Mapping[str, str], progress: Progress | None) -> Iterator[Row]:
    for number, (run, data) in enumerate(zip(stamps, place.read(file, list(stamps)), strict=True)):
        if progress is not None:
            progress(file, number, len(stamps))
        if isinstance(data, StoreError):
            yield entries.unreadable(run, UNSETTLED, str(data))
        elif data is not None:
            yield entries.read(file, run, stamps[run], data)


class _Aligned:
    """Columns of one file's entries, in the order of `runs`, null where a run has none."""

    def __init__(self, rows: Rows, runs: Sequence[str]) -> None:
        numbers = {run: number for number, run in enumerate(rows.keys())}
        self._rows = rows
        self._indices = pa.array([numbers.get(run) for run in runs], pa.int64())
        self._same = rows.keys() == list(runs)

    def columns(self, names: Sequence[str] | None = None) -> dict[str, pa.ChunkedArray]:
        columns = self._rows.columns(names)
        return columns if self._same else {name: column.take(self._indices) for name, column in columns.items()}

    def values(self, name: str) -> list[Any]:
        """Plain values of one column; all None where no entry has it."""
        column = self.columns([name]).get(name)
        return [None] * len(self._indices) if column is None else column.to_pylist()


def _frame(
    place: Place, runs: Sequence[str], parts: Mapping[str, _Aligned], columns: Sequence[str] | None
) -> pd.DataFrame:
    summary, status = parts[SUMMARY], parts[STATUS]
    own = {
        "run_id": pa.array(runs, pa.string()),
        "state": pa.array(_states(place, runs, summary.values(entries.DAMAGED), status), pa.string()),
        "error": pa.array(_errors(summary, status), pa.string()),
        "path": pa.array([place.path(run) for run in runs], pa.string()),
        "step": pa.array(status.values("step"), pa.int64()),
        "created": pa.array(status.values("created"), pa.float64()),
        "heartbeat": pa.array(status.values("heartbeat"), pa.float64()),
        "note": pa.array(parts[ANNOTATIONS].values("note"), pa.string()),
    }
    found = summary.columns(columns)
    found.pop(entries.DAMAGED, None)
    frame = pa.table({"run_id": own["run_id"], "state": own["state"], "error": own["error"]} | found | own).to_pandas()
    frame["tags"] = pd.Series(
        [tuple(json.loads(tags or "[]")) for tags in parts[ANNOTATIONS].values("tags")], dtype=object
    )
    return frame if columns is None else frame[[name for name in columns if name in frame.columns]]


def _states(place: Place, runs: Sequence[str], damaged: Sequence[str | None], status: _Aligned) -> list[str]:
    stored = zip(runs, damaged, status.values("state"), status.values("record"), strict=True)
    return [
        "damaged" if reason else place.state(run, json.loads(record)) if record else state or "interrupted"
        for run, reason, state, record in stored
    ]


def _errors(summary: _Aligned, status: _Aligned) -> list[str | None]:
    parts = zip(summary.values(entries.DAMAGED), status.values("error"), summary.values("error"), strict=True)
    return [next(filter(None, reasons), None) for reasons in parts]
