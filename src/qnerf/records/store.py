"""Gives out runs to write: a new run, an interrupted one to go on with, nothing if it is finished or being written."""

import contextlib
import errno
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import yaml  # type: ignore[import-untyped]

from qnerf.config.identity import plain
from qnerf.records import owner, schemas
from qnerf.records.deletion import TRASH, delete_leftovers, require_run, temporary_folder
from qnerf.records.files import StoreError, json_bytes, refuse_links, remove_temporary_files, replace, reporting
from qnerf.records.location import RUN_ID, store_folder
from qnerf.records.owner import OwnerInfo, Ownership
from qnerf.records.parquet import encode
from qnerf.records.read import metric_parts, part_name, read_config, read_evaluation, read_status, read_summary, runs
from qnerf.records.writer import EMPTY_PART, Run, running_status


@dataclass(frozen=True)
class Claim:
    """The answer to a claim.

    new: there was no such run. resumed: there was one, and nobody alive owns it. finished, busy: there is nothing to do
    here and `run` is None. `message` is one line for the user.
    """

    outcome: Literal["new", "resumed", "finished", "busy"]
    dir: Path
    message: str
    run: Run | None = None


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
        types: Mapping[str, str] | None = None,
        force: bool = False,
    ) -> Claim:
        """Asks for the right to write `run_id`. Exactly one of several contenders gets it.

        config: resolved, plain values. overrides: what the user typed. columns: further columns of summary.parquet,
        there from the start, as `Run.write_summary` takes them. types: dotted option -> "int", "float", "bool" or
        "text", the type of its column; other options are float64, bool or text. force: throw away a finished or
        interrupted run and start again; the old content goes in one rename.

        Raises:
            ValueError: not a run id, or an option is not of its type.
            StoreError: the store cannot be written.
        """
        if not RUN_ID.fullmatch(run_id):
            raise ValueError(f"run_id: expected letters, digits, '.', '_', '-' after a letter or digit, got {run_id!r}")
        content = _InitialContent(run_id, plain(config), list(overrides), dict(columns or {}), dict(types or {}))
        directory = self.root / run_id
        if not force and read_status(directory).get("state") == "finished":
            return _finished(directory)
        with reporting(self.root):
            refuse_links(directory, self.root / TRASH)
            self.root.mkdir(parents=True, exist_ok=True)
        delete_leftovers(self.root)
        for _ in range(1000):
            if (claim := self._try(content, directory, force)) is not None:
                return claim
        raise StoreError(f"{directory}: cannot claim the run: its folder comes and goes all the time")

    def _try(self, content: "_InitialContent", directory: Path, force: bool) -> Claim | None:
        """None if another process came in between."""
        if _is_vacant(directory):
            published = _publish(self._make_folder(content, 0), directory)
            return None if published is None else self._opened("new", "new run", published, content)
        try:
            require_run(directory)
        except StoreError:
            if _is_vacant(directory):
                return None
            raise
        holder = owner.acquire(directory, self.watch)
        if holder is None:
            return None
        if isinstance(holder, OwnerInfo):
            return Claim("busy", directory, f"{directory}: already being written by {holder}")
        with _released_on_error(holder):
            before = read_status(directory).get("state")
            if not force and before == "finished":  # in the meantime
                holder.release()
                return _finished(directory)
            if force:
                published = self._replace_run(content, holder)
                return None if published is None else self._opened("new", "done over", published, content)
            remove_temporary_files(directory)
            content.complete(directory)
            onward = "from its checkpoint" if _has_checkpoint(directory) else "from the start"
            stored = before if before == "failed" else "interrupted"
            return self._opened("resumed", f"was {stored}, going on {onward}", holder, content)

    def _opened(
        self, outcome: Literal["new", "resumed"], message: str, ownership: Ownership, content: "_InitialContent"
    ) -> Claim:
        with _released_on_error(ownership):
            run = Run(ownership, resumed=outcome == "resumed", every=self.every, types=content.types)
        return Claim(outcome, run.dir, f"{run.dir}: {message}", run)

    def _make_folder(self, content: "_InitialContent", number: int) -> Ownership:
        """A complete folder of a run, still under a temporary name."""
        folder = temporary_folder(self.root, "new", content.run_id)
        try:
            with reporting(self.root / content.run_id):
                (folder / "owner").mkdir(parents=True)
                ownership = owner.create_owner(folder, number)
            assert ownership is not None
            content.complete(folder)
            content.write_status(folder, ownership)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        return ownership

    def _replace_run(self, content: "_InitialContent", current: Ownership) -> Ownership | None:
        # The number stays, so that a contender who looked at the old folder cannot become owner of the new one.
        new = self._make_folder(content, current.number)
        with contextlib.suppress(OSError):  # tags and note are the user's, they are no results
            shutil.copyfile(current.directory / "annotations.json", new.directory / "annotations.json")
        old = temporary_folder(self.root, "old", content.run_id)
        try:
            with reporting(current.directory, "be done over"):
                current.directory.rename(old)
        except StoreError:
            shutil.rmtree(new.directory, ignore_errors=True)
            raise
        try:
            return _publish(new, current.directory)
        finally:
            shutil.rmtree(old, ignore_errors=True)


def _publish(made: Ownership, directory: Path) -> Ownership | None:
    """Renames a complete folder to its final name; None if another process was faster."""
    with reporting(directory, "create the run's folder"):
        try:
            made.directory.rename(directory)
        except OSError as error:
            shutil.rmtree(made.directory, ignore_errors=True)
            if error.errno in (errno.EEXIST, errno.ENOTEMPTY):
                return None
            raise
    return Ownership(directory, made.number, made.nonce)


@contextlib.contextmanager
def _released_on_error(ownership: Ownership) -> Iterator[None]:
    try:
        yield
    except BaseException:
        with contextlib.suppress(StoreError):
            ownership.release()
        raise


def _is_vacant(directory: Path) -> bool:
    try:
        return not any(directory.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return True


def _has_checkpoint(directory: Path) -> bool:
    return any((directory / name).exists() for name in ("checkpoint.pt", "checkpoint.prev.pt"))


def _has_metrics(directory: Path) -> bool:
    return _is_readable(metric_parts, directory) and bool(metric_parts(directory))


def _finished(directory: Path) -> Claim:
    return Claim("finished", directory, f"{directory}: finished already; run.force=true does it over")


@dataclass
class _InitialContent:
    """What a run's folder holds before anything was computed."""

    run_id: str
    config: dict[str, Any]
    overrides: list[str]
    columns: dict[str, Any]
    types: dict[str, str] = field(default_factory=dict)

    def complete(self, folder: Path) -> None:
        """Writes what is missing or damaged."""

        def write(name: str, data: bytes) -> None:
            replace(folder / name, data, temporary_folder=folder, durable=False)

        with reporting(folder):
            (folder / "images").mkdir(exist_ok=True)
            (folder / "metrics").mkdir(exist_ok=True)
        if not _is_readable(read_config, folder):
            write("config.yaml", to_yaml(self.config).encode())
        if not (folder / "overrides.txt").exists():
            write("overrides.txt", "".join(f"{line}\n" for line in self.overrides).encode())
        if not _is_readable(read_evaluation, folder):
            write("eval.parquet", encode(schemas.evaluation([], 0)))
        if not _is_readable(read_summary, folder):
            row = self.columns | {"run_id": self.run_id, "state": "running"}
            write("summary.parquet", encode(schemas.summary(row, self.config, self.types)))
        if not _has_metrics(folder):
            write(f"metrics/{part_name(0)}", EMPTY_PART)

    def write_status(self, folder: Path, ownership: Ownership) -> None:
        now = time.time()
        status = {"run_id": self.run_id, "step": 0, "heartbeat": now, "created": now} | running_status(ownership)
        replace(folder / "status.json", json_bytes(status), durable=False)


def _is_readable(reader: Callable[[Path], Any], path: Path) -> bool:
    try:
        reader(path)
    except StoreError:
        return False
    return True


def to_yaml(config: Mapping[str, Any]) -> str:
    text: str = yaml.safe_dump(plain(config), sort_keys=False, allow_unicode=True, width=120)
    return text
