"""A run's tags and note: `annotations.json`, the one file of a run that others than its owner write.

    {"tags": ["baseline", "good"], "note": "..."}

The file is replaced whole, so a reader finds the old or the new version. Two processes of one machine that add a tag at
once go one after the other, and both tags stay. Of two machines the later one wins.
"""

import contextlib
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from qnerf.config.identity import is_unicode
from qnerf.records import files
from qnerf.records.deletion import require_run
from qnerf.records.files import StoreError, reporting
from qnerf.records.printable import printable

FILE = "annotations.json"
TAG_LENGTH = 64
TAGS = 100
NOTE_LENGTH = 10_000


@dataclass(frozen=True)
class Annotations:
    """tags: sorted, each once. note: free text. Both may contain control characters: show them with `printable`."""

    tags: tuple[str, ...] = ()
    note: str = ""


def read(run_dir: str | Path) -> Annotations:
    """A run's tags and note; empty if nobody has written any.

    Raises:
        StoreError: the file cannot be read or holds something else.
    """
    path = Path(run_dir) / FILE
    with reporting(path, "read"):
        try:
            content = files.read_json(path)
        except FileNotFoundError:
            return Annotations()
    tags, note = content.get("tags", []), content.get("note", "")
    if not isinstance(tags, list) or not all(isinstance(tag, str) for tag in tags) or not isinstance(note, str):
        raise StoreError(f'{path}: damaged: expected {{"tags": [texts], "note": text}}')
    return Annotations(tuple(sorted(set(tags))), note)


def change_tags(run_dir: str | Path, add: Iterable[str] = (), remove: Iterable[str] = ()) -> Annotations:
    """Adds and removes tags; returns the run's annotations afterwards.

    Raises:
        ValueError: not a tag (see `check_tag`), too many tags, or a tag to remove that the run does not have.
        StoreError: the file cannot be written.
    """
    add, remove = set(map(check_tag, add)), set(remove)
    with _changing(Path(run_dir)) as path:
        before = read(run_dir)
        if unknown := remove - set(before.tags):
            missing, existing = (", ".join(map(printable, tags)) for tags in (sorted(unknown), before.tags))
            raise ValueError(f"{Path(run_dir).name} has no tag {missing}; it has {existing or 'no tags'}")
        tags = set(before.tags) - remove | add
        if len(tags) > TAGS:
            raise ValueError(f"expected at most {TAGS} tags a run, got {len(tags)}")
        return _write(path, replace(before, tags=tuple(sorted(tags))))


def write_note(run_dir: str | Path, note: str) -> Annotations:
    """Replaces the note; an empty one removes it.

    Raises:
        ValueError: longer than `NOTE_LENGTH` characters, or not Unicode.
        StoreError: the file cannot be written.
    """
    if not is_unicode(note):
        raise ValueError(f"expected a note in UTF-8, got {note!r:.100}; the terminal's encoding may be another one")
    if len(note) > NOTE_LENGTH:
        raise ValueError(f"expected a note of at most {NOTE_LENGTH:,} characters, got {len(note):,}")
    with _changing(Path(run_dir)) as path:
        return _write(path, replace(read(run_dir), note=note))


def check_tag(tag: str) -> str:
    """The tag itself; ValueError unless it is 1 to `TAG_LENGTH` visible characters without spaces, commas and `=`."""
    fits = 0 < len(tag) <= TAG_LENGTH and tag.isprintable() and not any(c.isspace() or c in ",=" for c in tag)
    if not fits:
        raise ValueError(
            f"expected a tag of 1 to {TAG_LENGTH} visible characters without spaces, commas and '=', got {tag!r:.100}"
        )
    return tag


def _write(path: Path, annotations: Annotations) -> Annotations:
    data = files.json_bytes({"tags": list(annotations.tags), "note": annotations.note})
    files.replace(path, data)
    return annotations


@contextlib.contextmanager
def _changing(run_dir: Path) -> Iterator[Path]:
    """The path of the file, which no other process of this machine changes in the meantime."""
    require_run(run_dir)
    with reporting(run_dir / FILE):
        folder = os.open(run_dir, os.O_RDONLY)
    try:
        with contextlib.suppress(ImportError, OSError):  # where folders cannot be locked, the later change wins
            import fcntl

            fcntl.flock(folder, fcntl.LOCK_EX)
        yield run_dir / FILE
    finally:
        os.close(folder)
