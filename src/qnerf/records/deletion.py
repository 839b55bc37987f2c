"""What a run is, and how it is deleted.

A folder of a user must not be taken for a run because it has a file of the same name. A run has a record of an owner
in `owner/`, and a config.yaml beside a status.json that names the folder as its run. One of the two marks may be
damaged. A run is deleted by renaming it into the folder `.tmp` of its store, where everything is the store's own.
"""

import contextlib
import re
import secrets
import shutil
import time
from pathlib import Path
from typing import Literal

from qnerf.records import owner
from qnerf.records.files import StoreError, is_full, refuse_links, reporting
from qnerf.records.location import resolved
from qnerf.records.read import read_status, state

TRASH = ".tmp"
"""The folder of a store for runs that are being made or deleted."""

_TRASH_NAME = re.compile(r"(new|old)-(.+)-[0-9a-f]{16}")
_ABANDONED_S = 3600.0  # nobody takes so long to make a new run's folder


def is_run(folder: Path) -> bool:
    """Whether the folder was made by `RunStore.claim`."""
    try:
        status = read_status(folder)
        named = status.get("run_id") == folder.name and "claim" in status and (folder / "config.yaml").exists()
        return named or owner.was_owned(folder)
    except (OSError, StoreError):  # of another user, who lets nobody look
        return False


def holds_runs(folder: Path) -> bool:
    """Whether there is a run in the folder."""
    return folder.is_dir() and any(is_run(path) for path in folder.iterdir() if path.is_dir())


def require_run(folder: Path) -> None:
    """StoreError if the folder is not a run, or if it is a link."""
    refuse_links(folder, folder / "owner")
    # A file may be replaced between the listing and the reading.
    if not any(is_run(folder) for _ in range(3)):
        raise StoreError(f"{folder}: not a run: it has no owner/ or status.json that qnerf wrote for it")


def refuse_runs(folder: Path) -> None:
    """ValueError if the folder, which need not exist, is that of a run or lies in one: no other files go there."""
    absolute = resolved(folder)
    if any(is_run(path) for path in (absolute, *absolute.parents) if path.is_dir()):
        raise ValueError(f"{folder}: is in a run's folder; expected another one")


def delete_run(folder: Path) -> None:
    """Deletes a run for good, and what killed processes left of others that they were deleting.

    Raises:
        StoreError: it is a link or not a run, another process is writing it, or it cannot be removed.
    """
    require_run(folder)
    ownership = _take(folder)
    try:
        with reporting(folder, "delete"):
            gone = temporary_folder(folder.parent, "old", folder.name)
            folder.rename(gone)
    except StoreError:
        if ownership is not None:
            with contextlib.suppress(StoreError):
                ownership.release()
        raise
    with reporting(gone, "delete"):
        shutil.rmtree(gone)
    delete_leftovers(folder.parent)


def _take(folder: Path) -> owner.Ownership | None:
    """Acquires the run, so that nobody starts to write it meanwhile; None if the disk is too full to do so."""
    try:
        acquired = owner.acquire(folder)
    except StoreError as error:
        if not is_full(error) or state(folder) == "running":
            raise
        return None  # deleting runs is the way to free a full disk
    if isinstance(acquired, owner.OwnerInfo):
        raise StoreError(f"{folder}: being written by {acquired}; stop it first")
    if acquired is None:
        raise StoreError(f"{folder}: gone already")
    return acquired


def temporary_folder(store: Path, kind: Literal["new", "old"], run_id: str) -> Path:
    """A path in the store's `.tmp`, which is made if needed. new: a run that is being made; old: being deleted.

    Raises:
        StoreError: `.tmp` is a link.
    """
    refuse_links(store / TRASH)
    (store / TRASH).mkdir(parents=True, exist_ok=True)
    return store / TRASH / f"{kind}-{run_id}-{secrets.token_hex(8)}"


def delete_leftovers(store: Path) -> None:
    """Removes what killed processes left in `.tmp`: runs that were being deleted, and new ones that nobody makes any
    more."""
    if (store / TRASH).is_symlink():
        return
    for folder in (store / TRASH).glob("*-*"):
        match = _TRASH_NAME.fullmatch(folder.name)
        with contextlib.suppress(OSError):
            if match and (match[1] == "old" or abs(time.time() - folder.stat().st_mtime) > _ABANDONED_S):
                shutil.rmtree(folder, ignore_errors=True)
