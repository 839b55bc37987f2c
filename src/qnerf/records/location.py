"""Where a store may be: in a folder of this machine."""

import os
import re
from pathlib import Path

from qnerf.config.identity import is_unicode

DEFAULT = "runs"
"""The store of commands that are given none."""

RUN_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,199}")
"""A run's id as qnerf makes it. The folder of a renamed run may have any other name."""

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")


def store_folder(store: str | Path) -> Path:
    """The folder of a store, which need not exist yet.

    Raises:
        ValueError: it is a URL, empty, not a path, not Unicode, or begins with the `~` of a home folder, which a shell
            replaces and nobody else.
    """
    text = str(store)
    if not text.strip() or "\0" in text:
        raise ValueError(f"store: expected a folder, got {text!r}")
    if not is_unicode(text):
        raise ValueError(f"store: expected a folder whose name is UTF-8, got {text!r}")
    if _URL.match(text):
        raise ValueError(f"store: expected a folder, got {text}; copy the store here, or read its files with DuckDB")
    if (home := os.path.expanduser(text)) != text:
        raise ValueError(f"store: expected a folder, got {text}; write {home}")
    return Path(text)


def existing_store(store: str | Path) -> Path:
    """As `store_folder`, for reading: ValueError if there is no such folder. The default store may be absent."""
    folder = store_folder(store)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{store}: not a folder; expected a folder of runs")
    if str(store) != DEFAULT and not folder.exists():
        raise ValueError(f"{store}: no such folder; expected a folder of runs")
    return folder
