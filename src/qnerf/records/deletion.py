"""What a run is, and how it is deleted.

A folder of a user must not be taken for a run because it has a file of the same name. So a run has at least one of
three marks. Every run has all of them from its first moment, but files may be damaged, by a power cut for example.

- a record of an owner in `owner/`,
- a config.yaml, and a status.json that names this folder as its run,
- the names of all files that a new run has.

A run is deleted in two steps. It is renamed into the folder `.tmp` of its store, then removed there, its `owner/` last:
if the process is killed in between, what remains can still be told from a folder of the user.
"""

import contextlib
import errno
import re
import secrets
import time
from pathlib import Path
from typing import Any, Literal

from qnerf.records import owner
from qnerf.records.files import (
    TRASH,
    StoreError,
    delete,
    entries_in,
    folders_in,
    make_folder,
    read_json,
    refuse_links,
    rename,
    reporting,
    status,
)
from qnerf.records.location import resolved
from qnerf.records.numbered import OWNERS
from qnerf.records.owner import OwnerInfo, Ownership, Process
from qnerf.records.read import state

_FIRST_FILES = {"config.yaml", "overrides.txt", "eval.parquet", "summary.parquet", "metrics", "images"}
_NONCE = re.compile(r"[0-9a-f]{16}")
_TRASH_NAME = re.compile(r"(new|old)-(.+)-[0-9a-f]{8}")
_UNFINISHED = re.compile(r"\.[0-9]{6}\.json\.[0-9a-f]{8}\.tmp")
_ABANDONED_S = 3600.0  # nobody takes so long to make a new run's folder


def is_run(folder: Path, run_id: str | None = None) -> bool:
    """Whether the folder was made by `RunStore.claim`; False for a link. run_id: by default the folder's name."""
    try:
        owners = OWNERS.in_folder(folder / "owner").values()
    except (OSError, StoreError):
        owners = {}.values()
    if any(_is_owner(_read(path)) for path in owners):
        return True
    try:
        names = entries_in(folder).keys()
    except (OSError, StoreError):
        return False
    stored = _read(folder / "status.json") if "config.yaml" in names else {}
    if stored.get("run_id") == (run_id or folder.name) and _is_nonce(stored.get("claim")):
        return True
    return bool(owners) and names >= _FIRST_FILES


def holds_runs(folder: Path) -> bool:
    """Whether there is a run in the folder."""
    return folder.is_dir() and any(map(is_run, folders_in(folder, root=folder)))


def require_run(folder: Path) -> None:
    """StoreError if the folder is not a run, or if it is a link."""
    refuse_links(folder, root=folder.parent)
    refuse_links(folder / "owner")
    # A file may be replaced between the listing and the reading.
    if not any(is_run(folder) for _ in range(3)):
        raise StoreError(f"{folder}: not a run: it has no owner/ or status.json that qnerf wrote for it")


def refuse_runs(folder: Path) -> None:
    """ValueError if the folder, which need not exist, is that of a run or lies in one: no other files go there."""
    absolute = resolved(folder)
    if any(is_run(path) for path in (absolute, *absolute.parents) if path.is_dir()):
        raise ValueError(f"{folder}: is in a run's folder; expected another one")


def _is_owner(record: dict[str, Any]) -> bool:
    return _is_nonce(record.get("nonce")) and Process.from_record(record) is not None and "released" in record


def _is_nonce(value: Any) -> bool:
    return isinstance(value, str) and _NONCE.fullmatch(value) is not None


def _read(path: Path) -> dict[str, Any]:
    try:
        return read_json(path)
    except (OSError, ValueError):
        return {}


def delete_run(folder: Path) -> None:
    """Deletes a run for good, and what killed processes left of others that they were deleting.

    Raises:
        StoreError: it is a link or not a run, another process is writing it, or it cannot be removed.
    """
    require_run(folder)
    ownership = _take(folder)
    store = folder.parent
    try:
        with reporting(folder, "delete"):
            gone = temporary_folder(store, "old", folder.name)
            rename(folder, gone, root=store)
    except StoreError:
        if ownership is not None:
            with contextlib.suppress(StoreError):
                ownership.release()
        raise
    with reporting(gone, "delete"):
        discard(gone)
    delete_leftovers(store)


def _take(folder: Path) -> Ownership | None:
    """Acquires the run, so that nobody starts to write it meanwhile; None if the disk is too full to do so."""
    try:
        acquired = owner.acquire(folder)
    except StoreError as error:
        full = isinstance(error.__cause__, OSError) and error.__cause__.errno in (errno.ENOSPC, errno.EDQUOT)
        if not full or state(folder) == "running":
            raise
        return None  # deleting runs is the way to free a full disk
    if isinstance(acquired, OwnerInfo):
        raise StoreError(f"{folder}: being written by {acquired}; stop it first")
    if acquired is None:
        raise StoreError(f"{folder}: gone already")
    return acquired


def temporary_folder(store: Path, kind: Literal["new", "old"], run_id: str) -> Path:
    """A path in the store's `.tmp`, which is made if needed. new: a run that is being made; old: being deleted.

    Raises:
        StoreError: `.tmp` is a link.
    """
    make_folder(store / TRASH, root=store)
    return store / TRASH / f"{kind}-{run_id}-{secrets.token_hex(4)}"


def discard(folder: Path, *, ignore_errors: bool = False) -> None:
    """Removes a folder of `temporary_folder`, its `owner/` last."""
    with contextlib.suppress(*([OSError] if ignore_errors else [])):
        for name in entries_in(folder):
            if name != "owner":
                delete(folder / name, ignore_errors=ignore_errors)
    delete(folder, ignore_errors=ignore_errors)


def delete_leftovers(store: Path, run_id: str | None = None) -> None:
    """Removes what killed processes left in `.tmp`: runs that were being deleted, and new ones that nobody makes any
    more. run_id: only those of this run.

    Raises:
        StoreError: `.tmp` is a link.
    """
    try:
        folders = folders_in(store / TRASH)
    except OSError:
        return
    for folder in folders:
        match = _TRASH_NAME.fullmatch(folder.name)
        if match is None or run_id not in (None, match[2]):
            continue
        with contextlib.suppress(OSError, StoreError):
            ours = _is_hollow(folder) or is_run(folder, match[2])
            if ours and (match[1] == "old" or _is_abandoned(folder)):
                discard(folder, ignore_errors=True)


def _is_hollow(folder: Path) -> bool:
    """Whether the folder holds no more than `owner/`, and that no more than records that were not complete yet."""
    names = entries_in(folder)
    return not names or (list(names) == ["owner"] and all(map(_UNFINISHED.fullmatch, entries_in(folder / "owner"))))


def _is_abandoned(folder: Path) -> bool:
    """Whether nobody makes this new run any more. The clock decides only about processes of other machines."""
    with contextlib.suppress(OSError):
        _, record = owner.latest(folder)
        process = Process.from_record(record or {})
        if process is not None and (running := process.is_running()) is not None:
            return not running
    return abs(time.time() - status(folder, root=folder.parent.parent).st_mtime) > _ABANDONED_S
