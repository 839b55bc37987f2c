"""A run by what a user types: its folder, its id, or a part of its id that only one run has."""

import difflib
from pathlib import Path

from qnerf.records.read import runs


def find(name: str | Path, store: str | Path = "runs") -> Path:
    """The run's folder.

    name: a run's folder, or in `store` an id, or any part of an id that no other id contains.

    Raises:
        ValueError: no run or more than one; the line names the nearest ids.
    """
    folder = Path(name)
    if any((folder / file).exists() for file in ("status.json", "summary.parquet", "config.yaml")):
        return folder
    known = {path.name: path for path in runs(store)}
    text = str(name).rstrip("/")
    if text in known:
        return known[text]
    matches = [path for key, path in known.items() if text and text in key]
    if len(matches) == 1:
        return matches[0]
    if matches:
        raise ValueError(f"{text}: {len(matches)} runs in {store} match: {_some([m.name for m in matches])}")
    if not known:
        raise ValueError(f"{text}: no such run; there are no runs in {store}")
    near = difflib.get_close_matches(text, known, n=3, cutoff=0.3) or sorted(known)
    raise ValueError(f"{text}: no such run in {store}; it has {_some(near)}")


def _some(names: list[str], most: int = 4) -> str:
    shown = [name if name.isprintable() else ascii(name) for name in names[:most]]  # folders may be called anything
    return ", ".join(shown) + (f" and {len(names) - most} more" if len(names) > most else "")
