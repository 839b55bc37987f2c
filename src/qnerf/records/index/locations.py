"""Where a store lies and how versions of its files are told apart: in a folder here, behind a URL in `remote.py`."""

import hashlib
import os
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol

import pandas as pd

from qnerf.config.cache import cache_folder
from qnerf.records.files import MAX_JSON_BYTES, StoreError, folders_in, read_bytes, reporting
from qnerf.records.read import RUN_MARKERS, read_metrics, state

SUMMARY, STATUS, ANNOTATIONS = "summary.parquet", "status.json", "annotations.json"
MAX_BYTES = {SUMMARY: 2**24, STATUS: MAX_JSON_BYTES, ANNOTATIONS: MAX_JSON_BYTES}
"""The files of a run that the index reads -> the most bytes that each may have."""

SETTLED = 10.0
"""Seconds after which the next version of a file must have another time. File systems count in steps of up to 2 s, and
the clock of a file server may be a little behind."""

UNSETTLED = ""
"""Stamp of a file that changed more recently, or that cannot be looked at. It equals no stamp, not even itself."""

Stamps = dict[str, dict[str, str]]
"""Run -> file -> stamp, for the files that exist. A stamp identifies a version of a file."""


class Location(Protocol):
    """What the index needs to know about a store."""

    def index_folders(self) -> Sequence[Path]:
        """Where the index may lie, the best first."""

    def scan(self) -> Stamps:
        """All runs, sorted by name. Two versions of a file never have equal stamps, except `UNSETTLED`."""

    def read(self, file: str, runs: Sequence[str]) -> Iterator[bytes | StoreError | None]:
        """That file of each run: its bytes, why it cannot be read now, or None if it is gone."""

    def path(self, run: str) -> str: ...

    def state(self, run: str, status: dict[str, Any]) -> str:
        """The true state of a run whose status.json says that it is running."""

    def metrics(self) -> pd.DataFrame:
        """As `read_metrics`, if the location is one run."""


class FolderLocation:
    """A store on this machine's file systems. A stamp is modification time, change time, size and inode."""

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root)

    def index_folders(self) -> Sequence[Path]:
        in_store, in_cache = self.root / ".index", cached_index(str(self.root.absolute()))
        return [in_store, *in_cache] if os.access(self.root, os.W_OK) else [*in_cache, in_store]

    def scan(self) -> Stamps:
        with reporting(self.root, "read"):
            try:
                folders = folders_in(self.root, root=self.root)
            except (FileNotFoundError, NotADirectoryError):
                return {}
        return self.stamps(folder.name for folder in folders)

    def stamps(self, folders: Iterable[str]) -> Stamps:
        """As `scan`, of these folders alone; of those that are runs."""
        settled_time = settled_before()
        names = [name for name in folders if not name.startswith(".") and _is_unicode(name)]
        stamps = {name: _stamps(f"{self.root}/{name}", settled_time) for name in names}
        return {name: stamp for name, stamp in stamps.items() if stamp is not None}

    def read(self, file: str, runs: Sequence[str]) -> Iterator[bytes | StoreError | None]:
        for run in runs:
            path = self.root / run / file
            result: bytes | StoreError | None
            try:
                with reporting(path, "read"):
                    result = read_bytes(path, MAX_BYTES[file])
            except StoreError as error:
                is_gone = isinstance(error.__cause__, (FileNotFoundError, NotADirectoryError))
                result = None if is_gone else error
            yield result

    def path(self, run: str) -> str:
        return os.path.join(self.root, run)

    def state(self, run: str, status: dict[str, Any]) -> str:
        now = state(self.root / run, status)
        # A run that has ended since its files were read is shown as it was then.
        return now if now in ("running", "interrupted") else "running"

    def metrics(self) -> pd.DataFrame:
        return read_metrics(self.root)


def settled_before() -> float:
    """Unix time. A file that changed before it can be told from its next version."""
    return time.time() - SETTLED


def _stamps(folder: str, settled_time: float) -> dict[str, str] | None:
    """None if the folder is not a run."""
    stamps = {}
    for file in MAX_BYTES:
        try:
            status = os.lstat(f"{folder}/{file}")
        except (FileNotFoundError, NotADirectoryError):
            continue
        except OSError:  # the reason is reported when the file is read
            stamps[file] = UNSETTLED
            continue
        stamp = f"{status.st_mtime_ns} {status.st_ctime_ns} {status.st_size} {status.st_ino}"
        stamps[file] = stamp if max(status.st_mtime, status.st_ctime) < settled_time else UNSETTLED
    is_run = any(file in stamps or os.path.lexists(f"{folder}/{file}") for file in RUN_MARKERS)
    return stamps if is_run else None


def _is_unicode(name: str) -> bool:
    """False for names in another encoding, which no table can hold; qnerf's own names are ASCII."""
    return not any("\ud800" <= character <= "\udfff" for character in name)


def cached_index(store: str) -> list[Path]:
    """The folder for a store's index in the user's cache; empty without a cache."""
    folder = cache_folder()
    if folder is None:
        return []
    return [folder / "index" / hashlib.sha256(store.encode(errors="surrogateescape")).hexdigest()[:20]]
