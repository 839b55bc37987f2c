"""Finds a run by what a user types: its folder, its id, or a part of its id that no other run has."""

import difflib
import os
from pathlib import Path

from qnerf.records.location import existing_store
from qnerf.records.printable import printable
from qnerf.records.read import RUN_MARKERS, runs


def find(name: str | Path, store: str | Path = "runs", *, whole: bool = False) -> Path:
    """The run's folder.

    name: a run's folder, written with a separator (`runs/ID`, `./ID`); or in `store` an id, or any part of an id that
    no other id contains. A folder of the working directory that has the name of a run is not looked at.
    whole: a part of an id is refused.

    Raises:
        ValueError: no run or more than one, with the nearest ids.
    """
    text = str(name)
    if is_path(text):
        folder = Path(name).resolve()
        if not any((folder / file).exists() for file in RUN_MARKERS):
            raise ValueError(f"{text}: no such run; expected a folder with {' or '.join(RUN_MARKERS)}")
        return folder
    root = existing_store(store)
    if text and not text.startswith(".") and (root / text).is_dir():  # in a large store a listing takes long
        return root / text
    known = {path.name: path for path in runs(root)}
    matches = [run_id for run_id in known if text and text in run_id]
    if len(matches) == 1 and whole:
        raise ValueError(f"{text}: no such run in {store}; expected a whole id, such as {_listed(matches)}")
    if len(matches) == 1:
        return known[matches[0]]
    if matches:
        raise ValueError(f"{text}: {len(matches)} runs in {store} match: {_listed(matches)}")
    if not known:
        raise ValueError(f"{text}: no such run; there are no runs in {store}")
    nearest = difflib.get_close_matches(text, known, n=3, cutoff=0.3) or sorted(known)
    raise ValueError(f"{text}: no such run in {store}; it has {_listed(nearest)}")


def is_path(name: str) -> bool:
    """Whether a user means a folder, not an id."""
    return name in (os.curdir, os.pardir) or any(separator in name for separator in (os.sep, os.altsep) if separator)


def _listed(names: list[str], limit: int = 4) -> str:
    return ", ".join(map(printable, names[:limit])) + (f" and {len(names) - limit} more" if len(names) > limit else "")
