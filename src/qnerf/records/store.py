"""Gives out runs to write: a new run, an interrupted one to go on with, nothing if it is finished or being written."""

import contextlib
import errno
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import yaml  # type: ignore[import-untyped]

from qnerf.config.identity import identity, plain
from qnerf.records import live_parquet, owner, schemas, summary_row
from qnerf.records.deletion import delete_leftovers, discard, is_run, require_run, temporary_folder
from qnerf.records.files import (
    MAX_JSON_BYTES,
    SUBFOLDERS,
    TRASH,
    StoreError,
    delete,
    entries_in,
    exists,
    make_folder,
    read_bytes,
    refuse_links,
    remove_temporary_files,
    rename,
    replace,
    reporting,
    temporary_path,
)
from qnerf.records.location import RUN_ID, store_folder
from qnerf.records.numbered import PARTS
from qnerf.records.owner import OwnerInfo, Ownership
from qnerf.records.read import read_config, read_evaluation, read_status, read_summary, runs
from qnerf.records.writer import EMPTY_PART, FORMAT, Run, running_status


@dataclass(frozen=True)
class Claim:
    """The answer to a claim.

    new: there was no such run. resumed: there was one, and nobody alive owns it. finished, busy: there is nothing to do
    here and `run` is None; `owner` says who writes a busy run. `message` is one line for the user.
    """

    outcome: Literal["new", "resumed", "finished", "busy"]
    dir: Path
    message: str
    run: Run | None = None
    owner: OwnerInfo | None = None


class RunStore:
    """A folder of runs, created at the first claim.

    every: seconds between flushes and heartbeats. watch: how many seconds the old heartbeat of a writer on another
    machine is watched before its run is taken over.
    """

    def __init__(
        self, root: str | Path, *, every: float = owner.HEARTBEAT_INTERVAL, watch: float = owner.WATCH_TIME
    ) -> None:
        self.root = store_folder(root)
        self.every = every
        self.watch = watch

    def runs(self) -> list[Path]:
        return runs(self.root)

    def claim(
        self,
        run_id: str,
        config: Mapping[str, Any],
        overrides: Iterable[str] = (),
        *,
        columns: Mapping[str, Any] | None = None,
        force: bool = False,
    ) -> Claim:
        """Asks for the right to write `run_id`. Exactly one of several contenders gets it.

        config: resolved, plain values. overrides: what the user typed. columns: further columns of summary.parquet,
        there from the start, as `Run.write_summary` takes them. force: throw away a finished or interrupted run and
        start again; the old content goes in one rename.

        Raises:
            ValueError: not a run id.
            StoreError: the store cannot be written.
        """
        if not RUN_ID.fullmatch(run_id):
            raise ValueError(f"run_id: expected letters, digits, '.', '_', '-' after a letter or digit, got {run_id!r}")
        content = _InitialContent(run_id, plain(config), list(overrides), dict(columns or {}))
        directory = self.root / run_id
        if not force and read_status(directory).get("state") == "finished":
            return _finished(directory)
        with reporting(self.root):
            self.root.mkdir(parents=True, exist_ok=True)
            make_folder(self.root / TRASH, root=self.root)
        delete_leftovers(self.root, run_id)
        for _ in range(1000):
            refuse_links(directory, root=self.root)
            refuse_links(*(directory / name for name in sorted(SUBFOLDERS)))
            if self._is_vacant(directory):
                published = self._publish(self._make_folder(content, 0), directory)
                if published is None:
                    continue
                return Claim("new", directory, f"{directory}: new run", self._open(published, resumed=False))
            if not is_run(directory) and self._is_vacant(directory):
                continue
            require_run(directory)
            holder = owner.acquire(directory, self.watch)
            if holder is None:
                continue
            if isinstance(holder, OwnerInfo):
                return Claim("busy", directory, f"{directory}: already being written by {holder}", owner=holder)
            before = read_status(directory).get("state")
            if not force and before == "finished":  # in the meantime
                holder.release()
                return _finished(directory)
            with _released_on_error(holder):
                if force:
                    published = self._replace_run(content, holder)
                    if published is None:
                        continue
                    return Claim("new", directory, f"{directory}: done over", self._open(published, resumed=False))
                _refuse_newer_format(directory)
                remove_temporary_files(directory)
                without_rows = _has_begun(directory) and not _has_metrics(directory)
                content.complete(directory)
            onward = "from its checkpoint" if _has_checkpoint(directory) else "from the start"
            stored = before if before == "failed" else "interrupted"
            message = f"{directory}: was {stored}, going on {onward}"
            run = self._open(holder, resumed=True)
            if without_rows:
                run.warn(f"{directory / 'metrics'}: missing or empty; the rows logged before are lost")
            return Claim("resumed", directory, message, run)
        raise StoreError(f"{directory}: cannot claim the run: its folder comes and goes all the time")

    def _open(self, ownership: Ownership, *, resumed: bool) -> Run:
        with _released_on_error(ownership):
            return Run(ownership, resumed=resumed, every=self.every)

    def _make_folder(self, content: "_InitialContent", number: int) -> Ownership:
        """A complete folder of a run, still under a temporary name."""
        with reporting(self.root / content.run_id):
            folder = temporary_folder(self.root, "new", content.run_id)
            make_folder(folder)
        try:
            with reporting(self.root / content.run_id):
                make_folder(folder / "owner")
                ownership = owner.create(folder, number)
            assert ownership is not None
            content.complete(folder)
            content.write_status(folder, ownership)
        except BaseException:
            delete(folder, ignore_errors=True)
            raise
        return ownership

    def _publish(self, made: Ownership, directory: Path) -> Ownership | None:
        """Renames a complete folder to its final name; None if another process was faster."""
        with reporting(directory, "create the run's folder"):
            try:
                rename(made.directory, directory, root=self.root)
            except OSError as error:
                delete(made.directory, ignore_errors=True)
                if error.errno in (errno.EEXIST, errno.ENOTEMPTY):
                    return None
                raise
        return Ownership(directory, made.number, made.nonce)

    def _replace_run(self, content: "_InitialContent", current: Ownership) -> Ownership | None:
        # The number stays, so that a contender who looked at the old folder cannot become owner of the new one.
        new = self._make_folder(content, current.number)
        with contextlib.suppress(StoreError, OSError):  # tags and note are the user's, they are no results
            annotations = read_bytes(current.directory / "annotations.json", MAX_JSON_BYTES)
            replace(new.directory / "annotations.json", annotations)
        try:
            with reporting(current.directory, "be done over"):
                old = temporary_folder(self.root, "old", content.run_id)
                rename(current.directory, old, root=self.root)
        except StoreError:
            delete(new.directory, ignore_errors=True)
            raise
        try:
            return self._publish(new, current.directory)
        finally:
            discard(old, ignore_errors=True)

    def _is_vacant(self, directory: Path) -> bool:
        try:
            return not entries_in(directory, root=self.root)
        except (FileNotFoundError, NotADirectoryError):
            return True


@contextlib.contextmanager
def _released_on_error(ownership: Ownership) -> Iterator[None]:
    try:
        yield
    except BaseException:
        with contextlib.suppress(StoreError):
            ownership.release()
        raise


def _has_checkpoint(directory: Path) -> bool:
    return any(exists(directory / name) for name in ("checkpoint.pt", "checkpoint.prev.pt"))


def _has_begun(directory: Path) -> bool:
    return _has_checkpoint(directory) or bool(read_status(directory).get("step"))


def _has_metrics(directory: Path) -> bool:
    try:
        return bool(PARTS.in_folder(directory / "metrics"))
    except FileNotFoundError:
        return False


def _refuse_newer_format(directory: Path) -> None:
    written = read_status(directory).get("format", FORMAT)
    if isinstance(written, int) and written > FORMAT:
        raise StoreError(
            f"{directory}: written by a newer qnerf (store format {written}, this one knows {FORMAT}); "
            "a newer qnerf goes on with it"
        )


def _finished(directory: Path) -> Claim:
    return Claim("finished", directory, f"{directory}: finished already; run.force=true does it over")


@dataclass
class _InitialContent:
    """What a run's folder holds before anything was computed."""

    run_id: str
    config: dict[str, Any]
    overrides: list[str]
    columns: dict[str, Any]

    def complete(self, folder: Path) -> None:
        """Writes what is missing or damaged."""

        def write(name: str, data: bytes) -> None:
            replace(folder / name, data, durable=False)

        with reporting(folder):
            make_folder(folder / "images")
            if not _is_readable(read_config, folder):
                write("config.yaml", to_yaml(self.config).encode())
            if not exists(folder / "overrides.txt"):
                write("overrides.txt", "".join(f"{line}\n" for line in self.overrides).encode())
            if not _is_readable(read_evaluation, folder):
                write("eval.parquet", live_parquet.encode(schemas.evaluation([], 0)))
            if not _is_readable(read_summary, folder):
                row = self.columns | {"run_id": self.run_id, "state": "running"}
                write("summary.parquet", summary_row.encode(schemas.summary(row, self.config)))
            if not exists(folder / "metrics"):
                temporary = temporary_path(folder / "metrics")
                make_folder(temporary)
                replace(temporary / PARTS.name(0), EMPTY_PART, durable=False)
                rename(temporary, folder / "metrics")
            elif not _has_metrics(folder):
                replace(folder / "metrics" / PARTS.name(0), EMPTY_PART, temporary_folder=folder, durable=False)

    def write_status(self, folder: Path, ownership: Ownership) -> None:
        now = time.time()
        status = {"run_id": self.run_id, "step": 0, "heartbeat": now, "created": now} | running_status(ownership)
        status["config"] = identity(self.config)  # tells a configuration edited by hand from a scene that has changed
        replace(folder / "status.json", json.dumps(status, indent=1).encode(), durable=False)


def _is_readable(reader: Callable[[Path], Any], path: Path) -> bool:
    try:
        reader(path)
    except StoreError:
        return False
    return True


class _Dumper(yaml.SafeDumper):
    """Quotes text that other parsers take for a number, such as 1e-2, and text with unusual characters."""


def _text(dumper: yaml.SafeDumper, text: str) -> Any:
    style = None if text.isprintable() else '"'
    with contextlib.suppress(ValueError):
        float(text)
        style = style or "'"
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_Dumper.add_representer(str, _text)


def to_yaml(config: Mapping[str, Any]) -> str:
    text: str = yaml.dump(plain(config), Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=120)
    return text
