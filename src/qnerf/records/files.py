"""Files that are either the old or the new version, never half of one; and that are files, not links or pipes."""

import contextlib
import json
import os
import secrets
import shutil
import stat
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any


class StoreError(ValueError):
    """The store cannot be read or written as it should; one line that says which path and why."""


@contextlib.contextmanager
def reporting(path: Path, doing: str = "write") -> Iterator[None]:
    """Turns an OSError into a StoreError that names `path`."""
    try:
        yield
    except OSError as error:
        raise StoreError(f"{path}: cannot {doing}: {error.strerror or error}") from error


def open_plain(path: Path, mode: str = "rb") -> IO[bytes]:
    """Opens a file of a run's folder. OSError as usual; StoreError where it is a link, a folder, a pipe or a device.

    A run writes no links, and a folder that came from somebody else must not lead a reader or a writer elsewhere.
    """
    with contextlib.suppress(FileNotFoundError):
        kind = path.lstat().st_mode
        if stat.S_ISLNK(kind):
            raise StoreError(f"{path}: is a link; the files of a run are not read or written through links")
        if not stat.S_ISREG(kind):
            raise StoreError(f"{path}: expected a file, got a folder, a pipe or a device")
    return open(path, mode, opener=_open_at_once)


def _open_at_once(path: str, flags: int) -> int:
    """Should it be replaced in this moment: neither follows a link nor waits for the other end of a pipe."""
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0), 0o666)


def read_bytes(path: Path, most: int) -> bytes:
    """The whole file, as `open_plain`; StoreError where it has more than `most` bytes."""
    with open_plain(path) as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise StoreError(f"{path}: larger than the {most:,} bytes that such a file may have")
    return data


def read_record(path: Path, most: int = 2**20) -> dict[str, Any]:
    """A small JSON object; ValueError where the file holds anything else."""
    try:
        record = json.loads(read_bytes(path, most))
    except RecursionError:
        raise ValueError(f"{path}: nested too deeply") from None
    if not isinstance(record, dict):
        raise ValueError(f"{path}: expected an object, got {type(record).__name__}")
    return record


class _Sink:
    """A file that remembers its own error: torch.save hides what the file said behind a message of its own."""

    def __init__(self, file: IO[bytes]) -> None:
        self.file = file
        self.error: OSError | None = None

    def write(self, data: Any) -> int:
        try:
            return self.file.write(data)
        except OSError as error:
            self.error = error
            raise

    def flush(self) -> None:
        try:
            self.file.flush()
        except OSError as error:
            self.error = error
            raise


def replace(
    path: Path,
    content: bytes | Callable[[Any], None],
    *,
    scratch: Path | None = None,
    durable: bool = True,
    check: Callable[[Path], None] | None = None,
    before: Callable[[], None] | None = None,
) -> None:
    """Writes `path` whole: to a temporary name in `scratch` (the same file system), then renamed over the old file.

    content: bytes, or a function that writes to the file it is given. durable: on disk before the rename, so that not
    even a power cut leaves half a file. check: called with the temporary file; before: called just before the rename.
    Whatever goes wrong, the old file stays and the temporary one goes; an OSError becomes a StoreError.
    """
    temporary = (scratch or path.parent) / f".{path.name}.{secrets.token_hex(4)}.tmp"
    with reporting(path):
        try:
            with open(temporary, "xb") as file:
                if callable(content):
                    _fill(file, content)
                else:
                    file.write(content)
                file.flush()
                if durable:
                    os.fsync(file.fileno())
            if check is not None:
                check(temporary)
            if before is not None:
                before()
            os.replace(temporary, path)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink()
            raise
        if durable:
            settle(path.parent)


def _fill(file: IO[bytes], content: Callable[[Any], None]) -> None:
    sink = _Sink(file)
    try:
        content(sink)
    except Exception:
        if sink.error is not None:
            raise sink.error from None
        raise


def settle(folder: Path) -> None:
    """Renames in `folder` reach the disk; where folders cannot be synchronised this does nothing."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def keep_copy(path: Path, name: Path) -> None:
    """`name` becomes what `path` is now, and `path` stays: a hard link, or a rename where there are none."""
    temporary = name.parent / f".{name.name}.{secrets.token_hex(4)}.tmp"
    try:
        os.link(path, temporary)
    except FileNotFoundError:
        return
    except OSError:
        if path.exists():
            os.replace(path, name)
        return
    os.replace(temporary, name)
    temporary.unlink(missing_ok=True)  # it stays where both are links to one file already


def remove_leftovers(folder: Path, *, age_s: float = 0.0) -> None:
    """Temporary files of a writer that was killed. age_s: only those so old, where others may be writing."""
    for path in folder.glob(".*.tmp"):
        with contextlib.suppress(OSError):
            if age_s and time.time() - path.lstat().st_mtime < age_s:
                continue
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()
