"""Where a store's files lie and what tells their versions apart: here a folder; `remote.py` has the same for URLs."""

import hashlib
import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol

import pandas as pd

from qnerf.config.cache import cache_folder
from qnerf.records.files import StoreError, read_bytes
from qnerf.records.read import read_metrics, state

SUMMARY, STATUS, ANNOTATIONS = "summary.parquet", "status.json", "annotations.json"
FILES = {SUMMARY: 2**24, STATUS: 2**20, ANNOTATIONS: 2**20}
"""Files of a run that the index is made of -> most bytes that one may have."""

RUN_FILES = (SUMMARY, STATUS, "config.yaml")
"""A folder that holds one of these is a run."""

SETTLED = 10.0
"""Seconds after which the next version of a file cannot have the times of this one: file systems count in steps of up
to 2 s, and the clock of a file server may be a little behind."""

UNSETTLED = ""
"""Stamp of a file that changed too recently for that, or cannot be looked at: it equals no stamp."""

Stamps = dict[str, dict[str, str]]
"""Run -> file -> stamp, for the files that are there."""


class Place(Protocol):
    """What the index needs to know of a store."""

    def index_folders(self) -> Sequence[Path]:
        """Where the index may lie, the best first."""

    def scan(self) -> Stamps:
        """All runs, sorted by name. Two versions of a file never have equal stamps other than `UNSETTLED`."""

    def read(self, file: str, runs: Sequence[str]) -> Iterator[bytes | StoreError | None]:
        """That file of each run: its bytes, why it cannot be read now, or None where it is gone."""

    def path(self, run: str) -> str: ...

    def state(self, run: str, status: dict[str, Any]) -> str:
        """The true state of a run whose status.json says that it is running."""

    def metrics(self) -> pd.DataFrame:
        """As `read_metrics`, where the place is one run."""


class Folder:
    """A store on this machine's file systems. A stamp is modification time, change time, size and inode."""

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root)

    def index_folders(self) -> Sequence[Path]:
        own, cached = self.root / ".index", cached_index(str(self.root.absolute()))
        return [own, *cached] if os.access(self.root, os.W_OK) else [*cached, own]

    def scan(self) -> Stamps:
        try:
            with os.scandir(self.root) as entries:
                found = (entry.name for entry in entries if not entry.name.startswith(".") and entry.is_dir())
                names = sorted(name for name in found if _is_unicode(name))
        except (FileNotFoundError, NotADirectoryError):
            return {}
        except OSError as error:
            raise StoreError(f"{self.root}: cannot read: {error.strerror or error}") from error
        settled = settled_before()
        stamps = {name: _stamps(f"{self.root}/{name}", settled) for name in names}
        return {name: stamp for name, stamp in stamps.items() if stamp is not None}

    def read(self, file: str, runs: Sequence[str]) -> Iterator[bytes | StoreError | None]:
        for run in runs:
            path = self.root / run / file
            try:
                yield read_bytes(path, FILES[file])
            except (FileNotFoundError, NotADirectoryError):
                yield None
            except StoreError as error:
                yield error
            except OSError as error:
                yield StoreError(f"{path}: cannot read: {error.strerror or error}")

    def path(self, run: str) -> str:
        return os.path.join(self.root, run)

    def state(self, run: str, status: dict[str, Any]) -> str:
        found = state(self.root / run, status)
        # One that has ended since its files were read is shown as it was then.
        return found if found in ("running", "interrupted") else "running"

    def metrics(self) -> pd.DataFrame:
        return read_metrics(self.root)


def settled_before() -> float:
    """Unix time; a file that changed before it can be told from its next version."""
    return time.time() - SETTLED


def _stamps(folder: str, settled: float) -> dict[str, str] | None:
    """None where the folder is no run."""
    stamps = {}
    for file in FILES:
        try:
            found = os.lstat(f"{folder}/{file}")
        except (FileNotFoundError, NotADirectoryError):
            continue
        except OSError:  # reading tells what is wrong
            stamps[file] = UNSETTLED
            continue
        known = max(found.st_mtime, found.st_ctime) < settled
        stamp = f"{found.st_mtime_ns} {found.st_ctime_ns} {found.st_size} {found.st_ino}"
        stamps[file] = stamp if known else UNSETTLED
    if SUMMARY in stamps or STATUS in stamps or os.path.lexists(f"{folder}/config.yaml"):
        return stamps
    return None


def _is_unicode(name: str) -> bool:
    """Not so in another encoding, which no table can hold; qnerf's own names are ASCII."""
    return not any("\ud800" <= character <= "\udfff" for character in name)


def cached_index(store: str) -> list[Path]:
    """The folder for a store's index among the user's own; empty where there is none."""
    folder = cache_folder()
    if folder is None:
        return []
    return [folder / "index" / hashlib.sha256(store.encode(errors="surrogateescape")).hexdigest()[:20]]
