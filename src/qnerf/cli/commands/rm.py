"""`qnerf rm RUN...`: deletes runs, after asking."""

import argparse
import contextlib
import errno
import os
import secrets
import shutil
import sys
from collections.abc import Iterable
from pathlib import Path

from qnerf.cli.commands import add_many_runs
from qnerf.cli.text import STATE_STYLES, console, size, styled
from qnerf.records import StoreError, find, owner, state
from qnerf.records.files import reporting
from qnerf.records.owner import OwnerInfo, Ownership

MARKS = ("status.json", "summary.parquet", "owner")
"""A folder without any of these is not a run and is never deleted."""


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Deletes runs for good, after asking. A run that is being written is refused. Exit code 1: nothing was deleted."
    )
    add_many_runs(parser)
    parser.add_argument("--yes", "-y", action="store_true", help="delete without asking")


def main(options: argparse.Namespace) -> int:
    folders = list(dict.fromkeys(_checked(find(name, options.store).absolute()) for name in options.runs))
    out = console()
    for folder in folders:
        kind = "link" if folder.is_symlink() else state(folder)
        total = size(sum(_sizes(folder)))
        out.print(styled(folder, limit=200), styled(kind, STATE_STYLES.get(kind, "")), total, soft_wrap=True)
    if not options.yes and not _agreed(len(folders)):
        out.print("nothing deleted")
        return 1
    for folder in folders:
        delete(folder)
        out.print("deleted", styled(folder.name), soft_wrap=True)
    return 0


def delete(folder: Path) -> None:
    """Moves a run out of its store in one rename, then removes it. For a link, only the link is removed.

    Raises:
        StoreError: another process is writing the run, or it cannot be removed.
    """
    if folder.is_symlink():
        with reporting(folder, "delete"):
            folder.unlink()
        return
    ownership = _take(folder)
    try:
        trash = folder.parent / ".tmp"
        with reporting(folder, "delete"):
            trash.mkdir(exist_ok=True)
            gone = trash / f"old-{folder.name}-{secrets.token_hex(4)}"
            os.rename(folder, gone)
    except StoreError:
        if ownership is not None:
            ownership.release()
        raise
    with reporting(gone, "delete"):
        shutil.rmtree(gone)  # never follows a link
    for leftover in trash.glob("old-*"):  # of a command that was killed in between
        shutil.rmtree(leftover, ignore_errors=True)


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


def _checked(folder: Path) -> Path:
    if not folder.is_symlink():
        if not any((folder / mark).exists() for mark in MARKS):
            raise ValueError(f"{folder}: not a run, it has none of {', '.join(MARKS)}; nothing deleted")
        if state(folder) == "running":
            raise ValueError(f"{folder}: running; stop it first; nothing deleted")
    return folder


def _agreed(count: int) -> bool:
    if not sys.stdin.isatty():
        raise ValueError("cannot ask, standard input is not a terminal: --yes deletes without asking")
    question = f"delete {'this run' if count == 1 else f'these {count} runs'} for good? [y/N] "
    return input(question).strip().lower() in ("y", "yes")


def _sizes(folder: Path) -> Iterable[int]:
    """Bytes of every file in the folder; links count as themselves."""
    if folder.is_symlink():
        return
    for root, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(OSError):
                yield os.lstat(os.path.join(root, name)).st_size
