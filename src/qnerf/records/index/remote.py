"""A store behind a URL that fsspec reads, such as s3://bucket/runs. Nothing is written there.

Versions of a file are told apart by size and entity tag, or by time if the storage has no tags. Only a run's own
machine can tell whether its process is alive. Here, a run that says "running" counts as interrupted if its last
heartbeat is older than `HEARTBEAT_LIMIT`.
"""

import contextlib
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import fsspec
import pandas as pd

from qnerf.records.files import StoreError, one_line
from qnerf.records.index.locations import MAX_BYTES, UNSETTLED, Stamps, cached_index, settled_before
from qnerf.records.numbered import PARTS
from qnerf.records.owner import is_recent, unix_time
from qnerf.records.read import MAX_TABLE_BYTES, RUN_MARKERS, read_metrics

BATCH = 500  # files that are fetched at once
_EXTRAS = {"s3": "s3", "s3a": "s3"}  # protocol -> the extra of this package that reads it
_TAGS = ("ETag", "etag", "md5Hash", "content_md5", "checksum", "generation")
_TIMES = ("LastModified", "last_modified", "mtime", "modified", "updated", "created")


class UrlLocation:
    """A store, or one run, behind a URL.

    Raises:
        ValueError: the protocol is unknown, its package is not installed, or the storage does not answer.
    """

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")
        self._sizes: dict[str, int] = {}  # path below the root -> bytes, as far as they were listed
        with self._reporting():
            self._file_system, self._root = fsspec.url_to_fs(self.url)

    def index_folders(self) -> Sequence[Path]:
        return cached_index(self.url)

    def scan(self) -> Stamps:
        settled_time = settled_before()
        stamps: dict[str, dict[str, str]] = {}
        for path, information in self._find().items():
            run, _, file = path.partition("/")
            if file in (*MAX_BYTES, *RUN_MARKERS) and not run.startswith("."):
                stamps.setdefault(run, {})[file] = _stamp(information, settled_time)
        return {run: stamps[run] for run in sorted(stamps) if not stamps[run].keys().isdisjoint(RUN_MARKERS)}

    def read(self, file: str, runs: Sequence[str]) -> Iterator[bytes | StoreError | None]:
        for first in range(0, len(runs), BATCH):
            yield from self._contents([f"{run}/{file}" for run in runs[first : first + BATCH]], MAX_BYTES[file])

    def path(self, run: str) -> str:
        return f"{self.url}/{run}"

    def state(self, run: str, status: Mapping[str, Any]) -> str:
        return "running" if is_recent(unix_time(status.get("heartbeat"))) else "interrupted"

    def metrics(self) -> pd.DataFrame:
        """As `read_metrics`, for the run at the URL."""
        names = [path for path in self._find("metrics") if PARTS.number(path.removeprefix("metrics/")) is not None]
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "metrics").mkdir()
            for name, data in zip(names, self._contents(names, MAX_TABLE_BYTES), strict=True):
                if isinstance(data, StoreError):
                    raise data
                if data is not None:
                    (Path(folder) / name).write_bytes(data)
            try:
                return read_metrics(folder)
            except StoreError as error:
                raise StoreError(str(error).replace(folder, self.url)) from error

    def _find(self, folder: str = "") -> dict[str, dict[str, Any]]:
        """Path below the root -> what the storage says about the file; empty if the folder does not exist."""
        with self._reporting():
            self._file_system.invalidate_cache()
            try:
                files = self._file_system.find(f"{self._root}/{folder}" if folder else self._root, detail=True)
            except FileNotFoundError:
                return {}
            if not files and not folder:  # find() takes a server that does not answer for an empty folder
                with contextlib.suppress(FileNotFoundError):
                    self._file_system.ls(self._root)
        start = len(self._root.rstrip("/")) + 1
        found = {path[start:]: information for path, information in files.items()}
        self._sizes |= {path: information.get("size") or 0 for path, information in found.items()}
        return found

    def _contents(self, paths: Sequence[str], max_bytes: int) -> Iterator[bytes | StoreError | None]:
        """The contents of these files, fetched in parallel; larger ones are not fetched."""
        small = [f"{self._root}/{path}" for path in paths if self._sizes.get(path, 0) <= max_bytes]
        with self._reporting():
            contents = self._file_system.cat(small, on_error="return") if small else {}
        for path in paths:
            if self._sizes.get(path, 0) > max_bytes:
                yield StoreError(f"{self.url}/{path}: larger than the {max_bytes:,} bytes that such a file may have")
                continue
            data = contents.get(f"{self._root}/{path}")
            if data is None or isinstance(data, FileNotFoundError):
                yield None
            elif isinstance(data, Exception):
                yield StoreError(f"{self.url}/{path}: cannot read: {one_line(data)}")
            else:
                yield data

    @contextlib.contextmanager
    def _reporting(self) -> Iterator[None]:
        protocol = self.url.partition("://")[0]
        try:
            yield
        except ImportError as error:
            extra = _EXTRAS.get(protocol)
            hint = f"pip install 'qnerf[{extra}]'" if extra else one_line(error)
            raise StoreError(f"{self.url}: reading {protocol}:// needs another package: {hint}") from error
        except Exception as error:  # every storage has its own errors
            raise StoreError(f"{self.url}: cannot read: {one_line(error)}") from error


def _stamp(information: Mapping[str, Any], settled_time: float) -> str:
    size = information.get("size")
    tag = next((information[key] for key in _TAGS if information.get(key)), None)
    if tag is not None:
        return f"{size} {tag}"
    changed = next((information[key] for key in _TIMES if information.get(key)), None)
    seconds = changed.timestamp() if isinstance(changed, datetime) else unix_time(changed)
    return f"{size} {seconds!r}" if seconds is not None and seconds < settled_time else UNSETTLED
