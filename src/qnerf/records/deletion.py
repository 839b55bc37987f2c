"""What a run is, and how it is deleted.

A folder of a user must not be taken for a run because it has a file of the same name. A run has a record of an owner
in `owner/`, or a config.yaml beside a status.json that names the folder as its run: one of the two may be damaged.
"""

import contextlib
import secrets
import shutil
import time
from pathlib import Path

from qnerf.records import owner
from qnerf.records.files import StoreError, reporting
from qnerf.records.read import read_status

NEW, _DELETED = ".new-", ".deleted-"
"""Beginnings of the name of a run's folder while it is made or deleted. Readers leave out what begins with a dot."""

_ABANDONED_S = 86_400.0  # nobody takes so long to make a run's folder, whatever the clocks of the machines say


def is_run(folder: Path) -> bool:
    """Whether the folder was made by `RunStore.claim`."""
    try:
        status = read_status(folder)
    except StoreError:  # of another user, who lets nobody look
        return False
    named = status.get("run_id") == folder.name and "claim" in status and (folder / "config.yaml").exists()
    return named or owner.latest(folder)[1].keys() >= {"pid", "nonce", "released"}


def holds_runs(folder: Path) -> bool:
    """Whether there is a run in the folder."""
    return folder.is_dir() and any(is_run(path) for path in folder.iterdir() if path.is_dir())


def require_run(folder: Path) -> None:
    """StoreError if the folder is not a run, or if it is a link: what is behind it may belong to somebody else."""
    if folder.is_symlink():
        raise StoreError(f"{folder}: is a link, behind which nothing is written or deleted")
    # A file may be replaced between the listing and the reading.
    if not any(is_run(folder) for _ in range(3)):
        raise StoreError(f"{folder}: not a run: it has no owner/ or status.json that qnerf wrote for it")


def refuse_runs(folder: Path) -> None:
    """ValueError if the folder, which need not exist, is that of a run or lies in one: no other files go there."""
    absolute = folder.resolve()
    if any(is_run(path) for path in (absolute, *absolute.parents) if path.is_dir()):
        raise ValueError(f"{folder}: is in a run's folder; expected another one")


def delete_run(folder: Path) -> None:
    """Deletes a run for good. It disappears in one rename. A process that begins to write it meanwhile stops.

    Raises:
        StoreError: it is a link or not a run, another process is writing it, or it cannot be removed.
    """
    require_run(folder)
    if (holder := owner.living(folder)) is not None:
        raise StoreError(f"{folder}: being written by {holder}; stop it first")
    gone = folder.with_name(f"{_DELETED}{folder.name}-{secrets.token_hex(8)}")
    with reporting(folder, "delete"):
        folder.rename(gone)
        with contextlib.suppress(FileNotFoundError):  # another command deletes it, too, as a leftover
            shutil.rmtree(gone)


def delete_leftovers(store: Path) -> None:
    """Removes runs that killed processes were deleting or making."""
    for folder in store.glob(f".*-{'[0-9a-f]' * 16}"):
        with contextlib.suppress(OSError):
            abandoned = folder.name.startswith(NEW) and time.time() - folder.stat().st_mtime > _ABANDONED_S
            if abandoned or folder.name.startswith(_DELETED):
                shutil.rmtree(folder)
