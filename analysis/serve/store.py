"""A store that is read again while runs train: which runs changed since a reader last asked.

A look at the store lists the stamps of all runs' files, and reads the runs whose stamps differ. Nobody looks unless a
page asks.
"""

import threading
import time
from pathlib import Path
from typing import Any

import pandas as pd

from qnerf.records import index
from qnerf.records.deletion import holds_runs
from qnerf.records.index import Stamps
from qnerf.records.location import existing_store

from .. import foreign, packed
from ..load import with_needed
from ..report import content
from ..report.columns import plain

Row = dict[str, Any]
"""The values of a run by column."""
FRESH = 0.5
"""Seconds for which a look at the store is good enough for the next question."""


class WatchedStore:
    """A folder of runs, which may be empty at first, or a table of `foreign.read` with its columns.

    All methods may be called from several threads.

    Raises:
        ValueError: there is no such folder, or it holds packed runs.
    """

    def __init__(self, store: str | Path, **columns: Any) -> None:
        self._foreign, self._columns = foreign.is_foreign(store), columns
        self._table: tuple[int, pd.DataFrame] | None = None  # when it changed, and its runs
        self.folder = Path(store) if self._foreign else existing_store(store)
        if packed.is_packed(self.folder) and not holds_runs(self.folder):
            raise ValueError(f"{store}: holds packed runs, which do not change; `qnerf report {store}` shows them")
        self._lock = threading.Lock()
        self._watch = index.Watch(self.folder)
        self._stamps = self._scan()
        frame = self._load()
        self._rows: dict[str, tuple[int, Row | None]] = {}  # version of a run's last change, and its row
        self._version = 0
        self._looked = time.monotonic()
        self._alive = set(frame.loc[frame["state"] == "running", "run_id"]) if len(frame) else set()

    def changes(self, since: int) -> tuple[int, dict[str, Row | None]]:
        """The version, and the runs that changed after `since`, each with its whole row; None: it is gone."""
        with self._lock:
            self._look()
            return self._version, {run: row for run, (version, row) in self._rows.items() if version > since}

    def frame(self) -> tuple[int, pd.DataFrame]:
        """The version, and the table of all runs as `load.runs` gives it, with the names of their configurations.

        An empty store gives an empty table.
        """
        with self._lock:
            self._look()
            version = self._version
        frame = self._load()
        if frame.empty:
            return version, frame
        return version, content.named(content.described(with_needed(frame)))

    def path(self, run: str) -> Path:
        """The folder of a run. ValueError if the store has no such run."""
        if run not in self._stamps:
            raise ValueError(f"{run:.100}: no such run")
        return self.folder / run

    def _load(self) -> pd.DataFrame:
        if not self._foreign:
            return index.load(self.folder)
        changed = self.folder.stat().st_mtime_ns
        if self._table is None or self._table[0] != changed:
            self._table = changed, foreign.read(self.folder, **self._columns)
        return self._table[1]

    def _scan(self) -> Stamps:
        """The stamps of all runs; a table of another program changes as a whole."""
        if self._foreign:
            return dict.fromkeys(self._load()["run_id"], str(self.folder.stat().st_mtime_ns))
        return self._watch.scan() if self.folder.is_dir() else {}

    def _look(self) -> None:
        """Reads what has changed, unless somebody did so within `FRESH` seconds."""
        if time.monotonic() - self._looked < FRESH:
            return
        stamps = self._scan()
        changed = [run for run, stamp in stamps.items() if self._stamps.get(run) != stamp or run in self._alive]
        rows = self._read(changed) | dict.fromkeys(self._stamps.keys() - stamps.keys())
        self._stamps, self._looked = stamps, time.monotonic()
        different = {run: row for run, row in rows.items() if run not in self._rows or self._rows[run][1] != row}
        if different:
            self._version += 1
            self._rows |= {run: (self._version, row) for run, row in different.items()}
            running = {run for run, row in different.items() if row is not None and row.get("state") == "running"}
            self._alive = self._alive - different.keys() | running

    def _read(self, runs: list[str]) -> dict[str, Row | None]:
        if not runs:
            return {}
        found = self._load() if self._foreign else index.load_runs(self.folder, runs)
        shown = content.described(with_needed(found[found["run_id"].isin(runs)]))
        rows: dict[str, Row | None] = {}
        for record in shown.drop(columns=["store", "scene"], errors="ignore").to_dict("records"):
            row = {str(name): plain(value) for name, value in record.items()}
            rows[record["run_id"]] = {name: value for name, value in row.items() if value is not None}
        return rows
