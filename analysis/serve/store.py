"""A store that is read again while runs train: which runs changed since a reader last asked.

A look at the store lists the stamps of all runs' files, and reads the runs whose stamps differ. Nobody looks unless a
page asks.
"""

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from qnerf.records import index
from qnerf.records.deletion import holds_runs
from qnerf.records.index import Stamps
from qnerf.records.location import existing_store

from .. import packed
from ..load import completed
from ..report import content
from ..report.columns import plain

FRESH = 0.5
"""Seconds for which a look at the store is good enough for the next question."""


@dataclass(frozen=True)
class Changes:
    """What a page does not know yet.

    rows: run -> column -> value, whole rows. removed: runs that are gone.
    """

    version: int
    rows: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    removed: tuple[str, ...] = ()


class WatchedStore:
    """A folder of runs, which may be empty at first. All methods may be called from several threads.

    Raises:
        ValueError: there is no such folder, or it holds packed runs.
    """

    def __init__(self, store: str | Path) -> None:
        self.folder = existing_store(store)
        if packed.is_packed(self.folder) and not holds_runs(self.folder):
            raise ValueError(f"{store}: holds packed runs, which do not change; `qnerf report {store}` shows them")
        self._lock = threading.Lock()
        self._stamps: Stamps = index.scan(self.folder)
        frame = index.load(self.folder)
        self._rows: dict[str, dict[str, Any]] = {}
        self._changed: dict[str, int] = {}  # run -> version in which its row changed last
        self._removed: dict[str, int] = {}
        self._version = 0
        self._looked = time.monotonic()
        self._alive = set(frame.loc[frame["state"] == "running", "run_id"]) if len(frame) else set()

    def changes(self, since: int) -> Changes:
        """What changed after a version."""
        with self._lock:
            self._look()
            return Changes(
                self._version,
                {run: self._rows[run] for run, version in self._changed.items() if version > since},
                tuple(run for run, version in self._removed.items() if version > since),
            )

    def frame(self) -> tuple[int, pd.DataFrame]:
        """The version, and the table of all runs as `load.runs` gives it, with the names of their configurations.

        An empty store gives an empty table.
        """
        with self._lock:
            self._look()
            version = self._version
        frame = index.load(self.folder)
        if frame.empty:
            return version, frame
        return version, content.named(content.described(completed(frame)))

    def path(self, run: str) -> Path:
        """The folder of a run. ValueError if the store has no such run."""
        if run not in self._stamps:
            raise ValueError(f"{run:.100}: no such run")
        return self.folder / run

    def _look(self) -> None:
        """Reads what has changed, unless somebody did so within `FRESH` seconds."""
        if time.monotonic() - self._looked < FRESH:
            return
        stamps = index.scan(self.folder)
        changed = {run for run, stamp in stamps.items() if self._stamps.get(run) != stamp}
        changed |= self._alive & stamps.keys()
        gone = self._stamps.keys() - stamps.keys()
        self._stamps = stamps
        self._looked = time.monotonic()
        rows = self._read(sorted(changed))
        different = {run: row for run, row in rows.items() if self._rows.get(run) != row}
        if not different and not gone:
            return
        self._version += 1
        self._rows |= different
        self._changed |= dict.fromkeys(different, self._version)
        for run in different:
            self._removed.pop(run, None)
            self._alive.discard(run)
            if different[run].get("state") == "running":
                self._alive.add(run)
        for run in gone:
            self._removed[run] = self._version
            for known in (self._rows, self._changed):
                known.pop(run, None)
            self._alive.discard(run)

    def _read(self, runs: list[str]) -> dict[str, dict[str, Any]]:
        if not runs:
            return {}
        shown = content.described(completed(index.load_runs(self.folder, runs)))
        rows = {}
        for record in shown.drop(columns=["store", "scene"], errors="ignore").to_dict("records"):
            row = {str(name): plain(value) for name, value in record.items()}
            rows[record["run_id"]] = {name: value for name, value in row.items() if value is not None}
        return rows
