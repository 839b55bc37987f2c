"""Where the commands of `analysis` write: into a folder of the user, which may have come from anybody."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from qnerf.records import StoreError
from qnerf.records.deletion import holds_runs, refuse_runs
from qnerf.records.files import replace, require_file


def write(path: Path, content: bytes | Callable[[Any], None]) -> None:
    """Replaces a file, whole or not at all.

    content: as in `records.files.replace`.

    Raises:
        StoreError: there is a link, a folder, a pipe or a device at the path.
        OSError: it cannot be written.
    """
    require_file(path)
    try:
        replace(path, content, durable=False)
    except StoreError as error:
        cause = error.__cause__
        if isinstance(cause, OSError):
            raise OSError(cause.errno, cause.strerror, str(path)) from error
        raise


def make_folder(folder: Path, *, store: bool = True) -> None:
    """Makes the folder and those above it.

    store: whether it may be one that holds runs.

    Raises:
        ValueError: the folder is a run's, or in one, or a store.
    """
    refuse_runs(folder)
    if not store and holds_runs(folder):
        raise ValueError(f"{folder}: expected a folder of its own, this is one of runs")
    folder.mkdir(parents=True, exist_ok=True)
