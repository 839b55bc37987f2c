"""A store behind a URL that fsspec reads, such as s3://bucket/runs. Nothing is written there.

Files are told apart by their size and entity tag, or by their time where the storage has no tags. Only a run's own
machine knows whether its process lives: from here, a run that says it is running counts as running while its last
heartbeat is younger than `HEARTBEAT_LIMIT`, and as interrupted from then on.
"""

import contextlib
import re
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import fsspec
import pandas as pd

from qnerf.records.files import StoreError
from qnerf.records.index.locations import FILES, RUN_FILES, UNSETTLED, Stamps, cached_index, settled_before
from qnerf.records.owner import HEARTBEAT_LIMIT, moment
from qnerf.records.read import read_metrics

BATCH = 500  # files that are asked for at once
_EXTRAS = {"s3": "s3", "s3a": "s3"}  # protocol -> this package's extra that reads it
_TAGS = ("ETag", "etag", "md5Hash", "content_md5", "checksum", "generation")
_TIMES = ("LastModified", "last_modified", "mtime", "modified", "updated", "created")
_PART = re.compile(r"metrics/part-\d+\.parquet")


class Remote:
    """A store, or one run, behind a URL.

    Raises:
        ValueError: the protocol is unknown, its package is not installed, or the storage does not answer.
    """

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")
        with self._reporting():
            self._files, self._root = fsspec.url_to_fs(self.url)

    def index_folders(self) -> Sequence[Path]:
        return cached_index(self.url)

    def scan(self) -> Stamps:
        settled = settled_before()
        found: dict[str, dict[str, str]] = {}
        for path, information in self._find().items():
            run, _, file = path.partition("/")
            if file in (*FILES, *RUN_FILES) and not run.startswith("."):
                found.setdefault(run, {})[file] = _stamp(information, settled)
        return {run: found[run] for run in sorted(found) if not found[run].keys().isdisjoint(RUN_FILES)}

    def read(self, file: str, runs: Sequence[str]) -> Iterator[bytes | StoreError | None]:
        for first in range(0, len(runs), BATCH):
            yield from self._contents([f"{run}/{file}" for run in runs[first : first + BATCH]])

    def path(self, run: str) -> str:
        return f"{self.url}/{run}"

    def state(self, run: str, status: Mapping[str, Any]) -> str:
        heartbeat = moment(status.get("heartbeat"))
        alive = heartbeat is not None and abs(time.time() - heartbeat) <= HEARTBEAT_LIMIT
        return "running" if alive else "interrupted"

    def metrics(self) -> pd.DataFrame:
        """As `read_metrics`, of the run that the URL leads to."""
        names = [path for path in self._find("metrics") if _PART.fullmatch(path)]
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "metrics").mkdir()
            for name, data in zip(names, self._contents(names), strict=True):
                if isinstance(data, StoreError):
                    raise data
                if data is not None:
                    (Path(folder) / name).write_bytes(data)
            try:
                return read_metrics(folder)
            except StoreError as error:
                raise StoreError(str(error).replace(folder, self.url)) from error

    def _find(self, folder: str = "") -> dict[str, dict[str, Any]]:
        """Path below the root -> what the storage says about the file; empty where the folder does not exist."""
        with self._reporting():
            self._files.invalidate_cache()
            try:
                found = self._files.find(f"{self._root}/{folder}" if folder else self._root, detail=True)
            except FileNotFoundError:
                return {}
        start = len(self._root.rstrip("/")) + 1
        return {path[start:]: information for path, information in found.items()}

    def _contents(self, paths: Sequence[str]) -> Iterator[bytes | StoreError | None]:
        """Of these files, fetched side by side."""
        full = [f"{self._root}/{path}" for path in paths]
        with self._reporting():
            found = self._files.cat(full, on_error="return")
        for path, name in zip(full, paths, strict=True):
            data = found.get(path, FileNotFoundError())
            if isinstance(data, FileNotFoundError):
                yield None
            elif isinstance(data, Exception):
                yield StoreError(f"{self.url}/{name}: cannot read: {_line(data)}")
            else:
                yield data

    @contextlib.contextmanager
    def _reporting(self) -> Iterator[None]:
        protocol = self.url.partition("://")[0]
        try:
            yield
        except ImportError as error:
            extra = _EXTRAS.get(protocol)
            hint = f"pip install 'qnerf[{extra}]'" if extra else _line(error)
            raise StoreError(f"{self.url}: reading {protocol}:// needs another package: {hint}") from error
        except Exception as error:  # every storage has errors of its own
            raise StoreError(f"{self.url}: cannot read: {_line(error)}") from error


def _stamp(information: Mapping[str, Any], settled: float) -> str:
    size = information.get("size")
    tag = next((information[key] for key in _TAGS if information.get(key)), None)
    if tag is not None:
        return f"{size} {tag}"
    changed = next((information[key] for key in _TIMES if information.get(key)), None)
    seconds = changed.timestamp() if isinstance(changed, datetime) else moment(changed)
    return f"{size} {seconds!r}" if seconds is not None and seconds < settled else UNSETTLED


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
