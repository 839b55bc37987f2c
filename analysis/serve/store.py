"""A store that is read again while runs train, and a number that grows when it has changed.

A look at the store lists the stamps of all runs' files. Nobody looks unless a page asks.
"""

import threading
import time
from pathlib import Path
from typing import Any

import pandas as pd

from qnerf.records import index, state
from qnerf.records.deletion import holds_runs
from qnerf.records.index import Stamps
from qnerf.records.location import existing_store

from .. import foreign, packed
from ..load import with_needed
from ..report import content

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
        self._stamps = self._scan()
        self._version = 0
        self._looked = time.monotonic()
        self._running: set[str] = set()  # runs that trained when the table was read

    def version(self) -> int:
        """Grows with every change of the runs: of their files, and of the state of one whose process has died."""
        with self._lock:
            if time.monotonic() - self._looked >= FRESH:
                stamps, before = self._scan(), self._stamps
                died = not self._foreign and any(state(self.folder / run) != "running" for run in self._running)
                self._version += stamps != before or died
                self._stamps, self._looked = stamps, time.monotonic()
            return self._version

    def frame(self) -> tuple[int, pd.DataFrame]:
        """The version, and the table of all runs as `load.runs` gives it, with the names of their configurations.

        An empty store gives an empty table.
        """
        version = self.version()
        frame = self._load()
        if frame.empty:
            return version, frame
        self._running = set(frame.loc[frame["state"] == "running", "run_id"])
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
        return index.scan(self.folder) if self.folder.is_dir() else {}
