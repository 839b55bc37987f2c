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

from qnerf.cli.commands import add_store
from qnerf.cli.text import STATE_STYLES, console, size, styled
from qnerf.records import StoreError, find, owner, state
from qnerf.records.files import reporting
from qnerf.records.owner import OwnerInfo, Ownership

MARKS = ("status.json", "summary.parquet", "owner")
"""A folder without any of them is no run, and stays."""


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Deletes runs for good. A run that is being written stays. Exit code 1: nothing was deleted."
    parser.add_argument("runs", nargs="+", metavar="RUN", help="a run's folder, its id, or a unique part of its id")
    add_store(parser)
    parser.add_argument("--yes", "-y", action="store_true", help="delete without asking")


def main(options: argparse.Namespace) -> int:
    folders = list(dict.fromkeys(_checked(find(name, options.store).absolute()) for name in options.runs))
    out = console()
    for folder in folders:
        what = "link" if folder.is_symlink() else state(folder)
        held = size(sum(_sizes(folder)))
        out.print(styled(folder, limit=200), styled(what, STATE_STYLES.get(what, "")), held, soft_wrap=True)
    if not options.yes and not _agreed(len(folders)):
        out.print("nothing deleted")
        return 1
    for folder in folders:
        delete(folder)
        out.print("deleted", styled(folder.name), soft_wrap=True)
    return 0


def delete(folder: Path) -> None:
    """Takes a run out of its store in one rename, then removes it. Of a link only the link goes.

    Raises:
        StoreError: somebody is writing the run, or it cannot be removed.
    """
    if folder.is_symlink():
        with reporting(folder, "delete"):
            folder.unlink()
        return
    held = _take(folder)
    try:
        trash = folder.parent / ".tmp"
        with reporting(folder, "delete"):
            trash.mkdir(exist_ok=True)
            gone = trash / f"old-{folder.name}-{secrets.token_hex(4)}"
            os.rename(folder, gone)
    except StoreError:
        if held is not None:
            held.release()
        raise
    with reporting(gone, "delete"):
        shutil.rmtree(gone)  # never follows a link
    for leftover in trash.glob("old-*"):  # of one that was killed in the middle
        shutil.rmtree(leftover, ignore_errors=True)


def _take(folder: Path) -> Ownership | None:
    """The right to write the run, so that nobody starts to in the meantime; None where the disk is too full for it."""
    try:
        held = owner.acquire(folder)
    except StoreError as error:
        full = isinstance(error.__cause__, OSError) and error.__cause__.errno in (errno.ENOSPC, errno.EDQUOT)
        if not full or state(folder) == "running":
            raise
        return None  # a full disk is what runs are deleted for
    if isinstance(held, OwnerInfo):
        raise StoreError(f"{folder}: being written by {held}; stop it first")
    if held is None:
        raise StoreError(f"{folder}: gone already")
    return held


def _checked(folder: Path) -> Path:
    if not folder.is_symlink():
        if not any((folder / mark).exists() for mark in MARKS):
            raise ValueError(f"{folder}: not a run, it has none of {', '.join(MARKS)}; nothing deleted")
        if state(folder) == "running":
            raise ValueError(f"{folder}: running; stop it first; nothing deleted")
    return folder


def _agreed(count: int) -> bool:
    if not sys.stdin.isatty():
        raise ValueError("nobody to ask, standard input is no terminal: --yes deletes without asking")
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
