"""How the files of a store are opened, replaced and deleted.

A run's folder may have come from anybody and may be read while it is written. Therefore files are opened with
`open_plain`, which never follows a link and never waits for a pipe; they change only through `replace`, so that a
reader finds the old version or the new one; and whole folders go through `delete`, which removes a link, never what
it leads to.
"""

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

from qnerf.records.plain_values import check_plain

MAX_JSON_BYTES = 2**20


class StoreError(ValueError):
    """The store cannot be read or written. The message is one line with the path and the reason."""


def one_line(error: BaseException) -> str:
    """The error's message without line breaks; its type where it has no message."""
    return " ".join(str(error).split()) or type(error).__name__


@contextlib.contextmanager
def reporting(path: Path, action: str = "write") -> Iterator[None]:
    """Turns an OSError into the StoreError "PATH: cannot ACTION: REASON"."""
    try:
        yield
    except OSError as error:
        raise StoreError(f"{path}: cannot {action}: {error.strerror or error}") from error


def refuse_links(*paths: Path) -> None:
    """StoreError if one of the paths is a link."""
    for path in paths:
        if path.is_symlink():
            raise StoreError(f"{path}: is a link; the files of a run are not read or written through links")


def open_plain(path: Path, mode: str = "rb") -> IO[bytes]:
    """Opens a regular file of a run's folder.

    Raises:
        StoreError: it is a link, a folder, a pipe or a device.
        OSError: it cannot be opened.
    """
    refuse_links(path)
    with contextlib.suppress(FileNotFoundError):
        if not stat.S_ISREG(path.lstat().st_mode):
            raise StoreError(f"{path}: expected a file, got a folder, a pipe or a device")
    return open(path, mode, opener=_open_without_waiting)


def _open_without_waiting(path: str, flags: int) -> int:
    """In case the file is replaced after the check: does not follow a link or wait for the other end of a pipe."""
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0), 0o666)


def read_bytes(path: Path, max_bytes: int) -> bytes:
    """The whole file, opened by `open_plain`; StoreError if it has more than `max_bytes`."""
    with open_plain(path) as file:
        data = file.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise StoreError(f"{path}: larger than the {max_bytes:,} bytes that such a file may have")
    return data


def parse_json(data: bytes) -> dict[str, Any]:
    """A JSON object; ValueError for anything else."""
    try:
        record = json.loads(data)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    if not isinstance(record, dict):
        raise ValueError(f"expected an object, got {type(record).__name__}")
    check_plain(record)
    return record


def read_json(path: Path) -> dict[str, Any]:
    """A small JSON object; StoreError if the file holds anything else, OSError if it cannot be read."""
    data = read_bytes(path, MAX_JSON_BYTES)
    try:
        return parse_json(data)
    except ValueError as error:
        raise StoreError(f"{path}: damaged: {error}") from error


class _ErrorKeepingFile:
    """Remembers its own OSError: torch.save hides it behind an error of its own."""

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
        """`replace` flushes at the end."""


def temporary_path(path: Path, folder: Path | None = None) -> Path:
    """A new hidden name, in the same folder by default; `remove_temporary_files` finds it after a kill."""
    return (folder or path.parent) / f".{path.name}.{secrets.token_hex(4)}.tmp"


def replace(
    path: Path,
    content: bytes | Callable[[Any], None],
    *,
    temporary_folder: Path | None = None,
    durable: bool = True,
    before_rename: Callable[[Path], None] | None = None,
) -> None:
    """Writes a temporary file and renames it to `path`. If anything fails, the old file stays as it was.

    content: bytes, or a function that writes to the file it receives.
    temporary_folder: where the temporary file lies; it must be on the same file system.
    durable: wait until the data are on the disk, so that not even a power cut leaves half a file.
    before_rename: called with the path of the complete temporary file; may raise.

    Raises:
        StoreError: in place of an OSError.
    """
    temporary = temporary_path(path, temporary_folder)
    with reporting(path):
        try:
            with open(temporary, "xb") as file:
                if callable(content):
                    _write_with(content, file)
                else:
                    file.write(content)
                file.flush()
                if durable:
                    os.fsync(file.fileno())
            if before_rename is not None:
                before_rename(temporary)
            os.replace(temporary, path)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink()
            raise
        if durable:
            _sync_folder(path.parent)


def _write_with(content: Callable[[Any], None], file: IO[bytes]) -> None:
    target = _ErrorKeepingFile(file)
    try:
        content(target)
    except Exception:
        if target.error is not None:
            raise target.error from None
        raise


def _sync_folder(folder: Path) -> None:
    """Waits until renames in the folder are on the disk; does nothing on systems that cannot."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def preserve(path: Path, copy: Path) -> None:
    """Replaces `copy` by what `path` is now, and leaves `path`: a hard link, or a rename where links do not exist."""
    temporary = temporary_path(copy)
    try:
        os.link(path, temporary)
    except FileNotFoundError:
        return
    except OSError:
        if path.exists():
            os.replace(path, copy)
        return
    os.replace(temporary, copy)
    temporary.unlink(missing_ok=True)  # the rename does nothing if both names were links to one file already


def delete(path: Path, *, ignore_errors: bool = False) -> None:
    """Removes a file, or a folder with all that it holds. Of a link only the link goes.

    ignore_errors: remove as much as possible; otherwise OSError as usual.
    """
    try:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=ignore_errors)
        else:
            path.unlink()
    except OSError:
        if not ignore_errors:
            raise


def remove_temporary_files(folder: Path, *, age_s: float = 0.0) -> None:
    """Deletes what killed writers left. age_s: only files at least so old, where others may be writing."""
    for path in folder.glob(".*.tmp"):
        with contextlib.suppress(OSError):
            if not age_s or time.time() - path.lstat().st_mtime >= age_s:
                delete(path)
