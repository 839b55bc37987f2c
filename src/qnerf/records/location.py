"""Where a store may be: in a folder of this machine. Some commands also read stores behind URLs (`index`)."""

import os
import re
from pathlib import Path

DEFAULT = "runs"
"""The store of commands that are given none."""

RUN_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,199}")
"""A run's id as qnerf makes it. The folder of a renamed run may have any other name."""

_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://")


def url_protocol(store: str | Path) -> str | None:
    """`s3` of `s3://bucket/runs`; None for a folder, also for one that is given as `file:///folder`.

    >>> url_protocol("s3://bucket/runs"), url_protocol("runs"), url_protocol("file:///runs")
    ('s3', None, None)
    """
    match = _URL.match(str(store))
    return None if match is None or match[1].lower() == "file" else match[1].lower()


def resolved(path: Path) -> Path:
    """The absolute path without links. One stays of links in a circle, for which `Path.resolve` raises RuntimeError."""
    return Path(os.path.realpath(path))


def store_folder(store: str | Path) -> Path:
    """The folder of a store, which need not exist yet.

    Raises:
        ValueError: it is a URL, empty or not a path.
    """
    text = str(store)
    if isinstance(store, str) and not text.strip():
        raise ValueError("store: expected a folder, got empty text")
    if "\0" in text:
        raise ValueError(f"store: expected a folder, got {text!r}")
    if url_protocol(store) is not None:
        raise ValueError(
            f"store: expected a folder of this machine, got {text}; runs behind a URL can only be listed and analysed"
        )
    return Path(text[len("file://") :] if text.lower().startswith("file://") else text)


def existing_store(store: str | Path) -> Path:
    """As `store_folder`, for reading: ValueError if there is no such folder. The default store may be absent."""
    folder = store_folder(store)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{store}: not a folder; expected a folder of runs")
    if str(store) != DEFAULT and not folder.exists():
        raise ValueError(f"{store}: no such folder; expected a folder of runs")
    return folder
