"""How the files of a store are opened and replaced.

A file is never changed in place. The new version is written under a temporary name and renamed, so a reader finds the
old version or the new one, and a killed writer leaves the old one and a temporary file.
"""

import contextlib
import errno
import json
import os
import secrets
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any


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


@contextlib.contextmanager
def reading(label: object) -> Iterator[None]:
    """Turns every error of a reader of damaged data into the StoreError "LABEL: damaged: REASON"."""
    try:
        yield
    except StoreError:
        raise
    except Exception as error:  # pyarrow, Pillow and PyTorch raise errors of many kinds for damaged files
        raise StoreError(f"{label}: damaged: {textwrap.shorten(one_line(error), 200, placeholder='...')}") from error


def parse_json(data: bytes) -> dict[str, Any]:
    """A JSON object; ValueError for anything else."""
    record = json.loads(data)
    if b"\\ud" in data or b"\\uD" in data:  # an escape may stand for half a character, which no table can hold
        json.dumps(record, ensure_ascii=False).encode()
    if not isinstance(record, dict):
        raise ValueError(f"expected an object, got {type(record).__name__}")
    return record


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object; StoreError if the file holds anything else, OSError if it cannot be read."""
    data = path.read_bytes()
    with reading(path):
        return parse_json(data)


def json_bytes(record: Any) -> bytes:
    """The record as a JSON file; what is not Unicode, such as a file name in another encoding, gets question marks."""
    return (json.dumps(record, indent=1, ensure_ascii=False) + "\n").encode(errors="replace")


def temporary_path(path: Path, folder: Path | None = None) -> Path:
    """A new hidden name, in the same folder by default; `remove_temporary_files` finds it after a kill."""
    return (folder or path.parent) / f".{path.name}.{secrets.token_hex(4)}.tmp"


def remove_temporary_files(folder: Path) -> None:
    """Deletes what killed writers left in a folder where nobody else writes."""
    for path in folder.glob(".*.tmp"):
        with contextlib.suppress(OSError):
            path.unlink()


def replace(
    path: Path,
    content: bytes | memoryview | Callable[[Any], None],
    *,
    temporary_folder: Path | None = None,
    durable: bool = True,
    before_rename: Callable[[], None] | None = None,
) -> None:
    """Writes a temporary file and renames it to `path`. If anything fails, the old file stays as it was.

    content: bytes, or a function that writes to the file it receives. temporary_folder: where the temporary file lies,
    on the same file system. durable: wait until the data are on the disk, so that not even a power cut leaves half a
    file. before_rename: called once the temporary file is complete; may raise.

    Raises:
        StoreError: in place of an OSError.
    """
    temporary = temporary_path(path, temporary_folder)
    with reporting(path):
        try:
            with open(temporary, "xb") as file:
                if callable(content):
                    content(file)
                else:
                    file.write(content)
                file.flush()
                if durable:
                    os.fsync(file.fileno())
            if before_rename is not None:
                before_rename()
            os.replace(temporary, path)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink()
            raise
        if durable:
            _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    """Waits until renames in the folder are on the disk; does nothing on systems that cannot."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def create(path: Path, data: bytes) -> bool:
    """Creates a file, exclusively and whole; False if there is one already."""
    temporary = temporary_path(path)
    try:
        temporary.write_bytes(data)
        os.link(temporary, path)
    except FileExistsError:
        # A network file system may repeat a request that had succeeded. The link count tells.
        return temporary.stat().st_nlink == 2
    except OSError as error:
        if isinstance(error, FileNotFoundError) or error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise
        try:  # this file system has no hard links
            with open(path, "xb") as file:
                file.write(data)
        except FileExistsError:
            return False
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()
    return True
