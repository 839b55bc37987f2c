"""How the files of a store are opened, listed, replaced and deleted.

A run's folder may have come from anybody and may change while it is read. Therefore everything in a store is reached
through this file:

    open_plain(path, mode, max_bytes=)   an open file            files_in(folder, pattern)   its regular files
    read_bytes(path, max_bytes)          its content             folders_in(folder)          its folders
    read_json(path)                      a small JSON object     entries_in(folder)          name -> lstat of everything
    exists(path), status(path)           without following
    replace(path, content)               the new version whole   make_folder(path)           unless it is there
    create(path, data)                   exclusively             delete(path), rename(source, target)

No function follows a link below the store's root, waits for a pipe or opens a device. Where the system can, folders are
opened one after the other, each from the one before, so that a folder which is swapped for a link after a check is
not followed either. The root itself, and what leads to it, may be links.

Every function takes `root=`, the store's folder. By default it is the parent of the run's folder, which is the first
one above the path that is not one of `SUBFOLDERS`. So a function that works on a run's folder as such, or lists the
root, needs `root=`. All raise StoreError for a link, OSError as usual.
"""

import contextlib
import errno
import fnmatch
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
MAX_DEPTH = 64

SUBFOLDERS = frozenset({"metrics", "images", "owner", ".annotations"})
"""Folders inside a run's folder."""

TRASH = ".tmp"
"""The folder of a store for runs that are being made or deleted."""

_DESCRIPTORS = hasattr(os, "O_NOFOLLOW") and {os.open, os.mkdir, os.rename, os.unlink, os.stat} <= os.supports_dir_fd
_NO_FOLLOW = getattr(os, "O_NOFOLLOW", 0)
_NO_WAIT = getattr(os, "O_NONBLOCK", 0)
_LIST = os.O_RDONLY | getattr(os, "O_DIRECTORY", 0)
_LINK_ITSELF = {"follow_symlinks": False} if os.link in os.supports_follow_symlinks else {}
_SEARCH = _LIST | getattr(os, "O_PATH", 0)  # a folder may be searched that may not be listed


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


def refuse_links(*paths: Path, root: Path | None = None) -> None:
    """StoreError if one of the paths, or a folder between it and the root, is a link."""
    for path in paths:
        with contextlib.suppress(OSError):
            if stat.S_ISLNK(status(path, root=root).st_mode):
                raise _is_a_link(path)


def _is_a_link(path: Path) -> StoreError:
    return StoreError(f"{path}: is a link; the files of a run are not read or written through links")


def _root_of(folder: Path) -> Path:
    """The root of the store to which a run's folder, or a folder in it, belongs."""
    while folder.name in SUBFOLDERS or _is_temporary(folder.name):
        folder = folder.parent
    return folder.parent.parent if folder.parent.name == TRASH else folder.parent


def _is_temporary(name: str) -> bool:
    return fnmatch.fnmatchcase(name, ".*.tmp")


@contextlib.contextmanager
def _opened(folder: Path, root: Path | None) -> Iterator[int | None]:
    """A descriptor of the folder, reached from the root without links; None where the system has none."""
    root = _root_of(folder) if root is None else root
    names = folder.relative_to(root).parts
    if ".." in names:
        raise StoreError(f"{folder}: expected a path without '..' inside a store")
    if not _DESCRIPTORS:
        for count in range(len(names)):
            if (path := root.joinpath(*names[: count + 1])).is_symlink():
                raise _is_a_link(path)
        yield None
        return
    handle = os.open(root, _SEARCH)
    try:
        for count, name in enumerate(names):
            try:
                inner = os.open(name, _SEARCH | _NO_FOLLOW, dir_fd=handle)
            except OSError as error:
                path = root.joinpath(*names[: count + 1])
                if error.errno in (errno.ELOOP, errno.ENOTDIR) and _is_link(name, handle):
                    raise _is_a_link(path) from None
                error.filename = str(path)
                raise
            os.close(handle)
            handle = inner
        yield handle
    finally:
        os.close(handle)


def _is_link(name: str, handle: int) -> bool:
    return stat.S_ISLNK(os.stat(name, dir_fd=handle, follow_symlinks=False).st_mode)


@contextlib.contextmanager
def _located(path: Path, root: Path | None) -> Iterator[tuple[str, int | None]]:
    """What the functions of `os` take: a name and the descriptor of its folder, or the whole path and None."""
    with _opened(path.parent, root) as handle:
        try:
            yield (str(path) if handle is None else path.name), handle
        except OSError as error:
            if error.filename == path.name:
                error.filename = str(path)
            raise


def status(path: Path, *, root: Path | None = None) -> os.stat_result:
    """As `os.lstat`."""
    with _located(path, root) as (name, handle):
        return os.stat(name, dir_fd=handle, follow_symlinks=False)


def exists(path: Path, *, root: Path | None = None) -> bool:
    """Whether there is something at the path, be it a broken link."""
    try:
        status(path, root=root)
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def open_plain(path: Path, mode: str = "rb", *, max_bytes: int | None = None, root: Path | None = None) -> IO[bytes]:
    """Opens a regular file of a store.

    Raises:
        StoreError: it is a link, a folder, a pipe or a device, or larger than `max_bytes`.
        OSError: it cannot be opened.
    """
    with _located(path, root) as (name, handle):

        def opener(_: str, flags: int) -> int:  # neither follows a link nor waits, if the file was swapped meanwhile
            return os.open(name, flags | _NO_FOLLOW | _NO_WAIT, 0o666, dir_fd=handle)

        with contextlib.suppress(FileNotFoundError):
            _require_file(path, os.stat(name, dir_fd=handle, follow_symlinks=False), max_bytes)
        file: IO[bytes] = open(path, mode, opener=opener)  # noqa: SIM115
    try:
        _require_file(path, os.fstat(file.fileno()), max_bytes)
    except BaseException:
        file.close()
        raise
    return file


def require_file(path: Path, *, root: Path | None = None) -> None:
    """StoreError if there is something else than a regular file at the path; nothing there is fine."""
    with contextlib.suppress(FileNotFoundError):
        _require_file(path, status(path, root=root), None)


def _require_file(path: Path, status: os.stat_result, max_bytes: int | None) -> None:
    if stat.S_ISLNK(status.st_mode):
        raise _is_a_link(path)
    if not stat.S_ISREG(status.st_mode):
        raise StoreError(f"{path}: expected a file, got a folder, a pipe or a device")
    if max_bytes is not None and status.st_size > max_bytes:
        raise _too_large(path, max_bytes)


def _too_large(path: Path, max_bytes: int) -> StoreError:
    return StoreError(f"{path}: larger than the {max_bytes:,} bytes that such a file may have")


@contextlib.contextmanager
def _listed(folder: Path, root: Path | None) -> Iterator[Iterator[os.DirEntry[str]]]:
    with _opened(folder, root) as handle:
        if handle is None:
            with os.scandir(folder) as entries:
                yield entries
            return
        readable = os.open(".", _LIST, dir_fd=handle)
        try:
            with os.scandir(readable) as entries:
                yield entries
        finally:
            os.close(readable)


def files_in(folder: Path, pattern: str = "*", *, root: Path | None = None) -> list[Path]:
    """The regular files of a folder whose names match, sorted; links are left out."""
    with _listed(folder, root) as entries:
        names = [e.name for e in entries if fnmatch.fnmatchcase(e.name, pattern) and e.is_file(follow_symlinks=False)]
    return [folder / name for name in sorted(names)]


def folders_in(folder: Path, *, root: Path | None = None) -> list[Path]:
    """The folders in a folder, sorted; links are left out."""
    with _listed(folder, root) as entries:
        names = [entry.name for entry in entries if entry.is_dir(follow_symlinks=False)]
    return [folder / name for name in sorted(names)]


def entries_in(folder: Path, *, root: Path | None = None) -> dict[str, os.stat_result]:
    """Everything in a folder, sorted by name, as `os.lstat` describes it."""
    with _listed(folder, root) as entries:
        found = []
        for entry in entries:
            with contextlib.suppress(FileNotFoundError):  # removed meanwhile
                found.append((entry.name, entry.stat(follow_symlinks=False)))
    return dict(sorted(found))


def total_size(folder: Path) -> int:
    """Bytes of all files in the folder and below; links count as themselves, what cannot be read as nothing.

    Folders below `MAX_DEPTH` are left out: each is reached from the root again.
    """
    root, total, folders = _root_of(folder), 0, [folder]
    deepest = len(folder.parts) + MAX_DEPTH
    while folders:
        folder = folders.pop()
        if len(folder.parts) > deepest:
            continue
        with contextlib.suppress(OSError, StoreError):
            for name, information in entries_in(folder, root=root).items():
                if stat.S_ISDIR(information.st_mode):
                    folders.append(folder / name)
                else:
                    total += information.st_size
    return total


def read_bytes(path: Path, max_bytes: int, *, root: Path | None = None) -> bytes:
    """The whole file, opened by `open_plain`; StoreError if it has more than `max_bytes`."""
    with open_plain(path, max_bytes=max_bytes, root=root) as file:
        data = file.read(max_bytes + 1)
    if len(data) > max_bytes:  # it grew
        raise _too_large(path, max_bytes)
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


def read_json(path: Path, *, root: Path | None = None) -> dict[str, Any]:
    """A small JSON object; StoreError if the file holds anything else, OSError if it cannot be read."""
    data = read_bytes(path, MAX_JSON_BYTES, root=root)
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
    root: Path | None = None,
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
    with (
        reporting(path),
        _located(path, root) as (name, folder),
        _located(temporary, root) as (temporary_name, other_folder),
    ):
        try:
            with open_plain(temporary, "xb", root=root) as file:
                if callable(content):
                    _write_with(content, file)
                else:
                    file.write(content)
                file.flush()
                if durable:
                    os.fsync(file.fileno())
            if before_rename is not None:
                before_rename(temporary)
            os.replace(temporary_name, name, src_dir_fd=other_folder, dst_dir_fd=folder)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(temporary_name, dir_fd=other_folder)
            raise
        if durable:
            _sync_folder(path.parent, folder)


def create(path: Path, data: bytes, *, root: Path | None = None) -> bool:
    """Creates a file, exclusively and whole; False if there is one already."""
    temporary = temporary_path(path)
    with open_plain(temporary, "xb", root=root) as file:
        file.write(data)
    with _located(path, root) as (name, folder), _located(temporary, root) as (temporary_name, _):
        try:
            os.link(temporary_name, name, src_dir_fd=folder, dst_dir_fd=folder, **_LINK_ITSELF)
        except FileExistsError:
            # A network file system may repeat a request that had succeeded. The link count tells.
            return os.stat(temporary_name, dir_fd=folder, follow_symlinks=False).st_nlink == 2
        except FileNotFoundError:
            raise
        except OSError:  # this file system has no hard links
            try:
                with open_plain(path, "xb", root=root) as file:
                    file.write(data)
            except (FileExistsError, StoreError):
                return False
        finally:
            with contextlib.suppress(OSError):
                os.unlink(temporary_name, dir_fd=folder)
    return True


def _write_with(content: Callable[[Any], None], file: IO[bytes]) -> None:
    target = _ErrorKeepingFile(file)
    try:
        content(target)
    except Exception:
        if target.error is not None:
            raise target.error from None
        raise


def _sync_folder(path: Path, handle: int | None) -> None:
    """Waits until renames in the folder are on the disk; does nothing on systems that cannot."""
    with contextlib.suppress(OSError):
        readable = os.open(path if handle is None else ".", os.O_RDONLY, dir_fd=handle)
        try:
            os.fsync(readable)
        finally:
            os.close(readable)


def preserve(path: Path, copy: Path, *, root: Path | None = None) -> None:
    """Replaces `copy` by what `path` is now, and leaves `path`: a hard link, or a rename where links do not exist."""
    temporary = temporary_path(copy)
    with (
        _located(path, root) as (name, folder),
        _located(copy, root) as (copy_name, copy_folder),
        _located(temporary, root) as (temporary_name, _),
    ):
        try:
            os.link(name, temporary_name, src_dir_fd=folder, dst_dir_fd=copy_folder, **_LINK_ITSELF)
        except FileNotFoundError:
            return
        except OSError:
            with contextlib.suppress(FileNotFoundError):
                os.replace(name, copy_name, src_dir_fd=folder, dst_dir_fd=copy_folder)
            return
        os.replace(temporary_name, copy_name, src_dir_fd=copy_folder, dst_dir_fd=copy_folder)
        with contextlib.suppress(FileNotFoundError):  # the rename does nothing if both were links to one file already
            os.unlink(temporary_name, dir_fd=copy_folder)


def rename(source: Path, target: Path, *, root: Path | None = None) -> None:
    """As `os.rename`: a folder replaces only an empty folder."""
    with _located(source, root) as (name, folder), _located(target, root) as (target_name, target_folder):
        os.rename(name, target_name, src_dir_fd=folder, dst_dir_fd=target_folder)


def make_folder(path: Path, *, root: Path | None = None) -> None:
    """Makes the folder unless it exists; its parent must exist."""
    with _located(path, root) as (name, handle):
        try:
            os.mkdir(name, dir_fd=handle)
        except FileExistsError:
            mode = os.stat(name, dir_fd=handle, follow_symlinks=False).st_mode
            if stat.S_ISLNK(mode):
                raise _is_a_link(path) from None
            if not stat.S_ISDIR(mode):
                raise


def delete(path: Path, *, ignore_errors: bool = False, root: Path | None = None) -> None:
    """Removes a file, or a folder with all that it holds. Of a link only the link goes.

    ignore_errors: remove as much as possible; otherwise OSError as usual.
    """
    try:
        with _located(path, root) as (name, handle):
            if not stat.S_ISDIR(os.stat(name, dir_fd=handle, follow_symlinks=False).st_mode):
                os.unlink(name, dir_fd=handle)
                return
            try:
                shutil.rmtree(name, ignore_errors=ignore_errors, dir_fd=handle)
            except RecursionError:
                raise OSError(errno.ENAMETOOLONG, "folders are nested too deeply", str(path)) from None
    except OSError:
        if not ignore_errors:
            raise


def remove_temporary_files(folder: Path, *, age_s: float = 0.0, root: Path | None = None) -> None:
    """Deletes what killed writers left. age_s: only files at least so old, where others may be writing."""
    now = time.time()
    for name, information in entries_in(folder, root=root).items():
        if _is_temporary(name) and (not age_s or now - information.st_mtime >= age_s):
            delete(folder / name, ignore_errors=True, root=root)
