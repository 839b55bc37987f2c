"""Gives out runs to write: a new run, an interrupted one to go on with, nothing if it is finished or being written."""

import contextlib
import errno
import json
import secrets
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import yaml  # type: ignore[import-untyped]

from qnerf.config.identity import picture_names, plain
from qnerf.records import owner, schemas
from qnerf.records.deletion import NEW, delete_leftovers, require_run
from qnerf.records.files import StoreError, json_bytes, remove_temporary_files, replace, reporting
from qnerf.records.location import RUN_ID, store_folder
from qnerf.records.owner import OwnerInfo, Ownership
from qnerf.records.parquet import encode
from qnerf.records.read import metric_parts, part_name, read_evaluation, read_status
from qnerf.records.schemas import PROBES
from qnerf.records.writer import EMPTY_PART, Run, running_status

CHECKPOINTS = ("checkpoint.pt", "checkpoint.prev.pt")
RESULTS = ("dirty.diff", "environment.json", "log.txt", "preview.png", "dataparser_transforms.json")


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

    every: seconds between flushes and heartbeats.
    """

    def __init__(self, root: str | Path, *, every: float = owner.HEARTBEAT_INTERVAL) -> None:
        self.root = store_folder(root)
        self.every = every

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
        "text", the type of its column; other options are float64, bool or text. force: throw away the results of a
        finished or interrupted run and start again; what a user has put into its folder stays.

        Raises:
            ValueError: not a run id, or an option is not of its type.
            StoreError: the store cannot be written, or a file of the run is damaged.
        """
        if not RUN_ID.fullmatch(run_id):
            raise ValueError(f"run_id: expected letters, digits, '.', '_', '-' after a letter or digit, got {run_id!r}")
        row = {**(columns or {}), "run_id": run_id, "state": "running"}
        start = _Start(
            run_id,
            {
                "summary.parquet": encode(schemas.summary(row, plain(config), types or {})),
                "config.yaml": to_yaml(config).encode(),
                "overrides.txt": "".join(f"{line}\n" for line in overrides).encode(errors="replace"),
                "eval.parquet": encode(schemas.evaluation([], 0)),
                f"metrics/{part_name(0)}": EMPTY_PART,
            },
        )
        directory = self.root / run_id
        if not force and read_status(directory).get("state") == "finished":
            return _finished(directory)
        delete_leftovers(self.root)
        for _ in range(1000):
            created = _is_vacant(directory)
            holder = self._create(directory, start) if created else self._take_over(directory)
            if isinstance(holder, OwnerInfo):
                return Claim("busy", directory, f"{directory}: already being written by {holder}")
            if holder is not None:
                with _released_on_error(holder):
                    return self._opened(holder, start, created, force, types)
        raise StoreError(f"{directory}: cannot claim the run: its folder comes and goes all the time")

    def _opened(
        self, ownership: Ownership, start: "_Start", created: bool, force: bool, types: Mapping[str, str] | None
    ) -> Claim:
        """The answer for the new owner. created: it has just made the folder."""
        directory = ownership.directory
        before = read_status(directory).get("state")
        if not force and before == "finished":  # in the meantime
            ownership.release()
            return _finished(directory)
        resumed = not created and not force
        message = "new run" if created else "done over"
        if resumed:
            onward = (
                "from its checkpoint" if any((directory / name).exists() for name in CHECKPOINTS) else "from the start"
            )
            message = f"was {'failed' if before == 'failed' else 'interrupted'}, going on {onward}"
        if not created:
            remove_temporary_files(directory)
            start.write(ownership, anew=force)
        run = Run(ownership, resumed=resumed, every=self.every, types=types)
        return Claim("resumed" if resumed else "new", directory, f"{directory}: {message}", run)

    def _create(self, directory: Path, start: "_Start") -> Ownership | None:
        """Makes a complete folder under a temporary name and renames it; None if another process was faster."""
        folder = directory.with_name(f"{NEW}{directory.name}-{secrets.token_hex(8)}")
        try:
            with reporting(directory, "create the run's folder"):
                (folder / "owner").mkdir(parents=True)
                made = owner.create_owner(folder, 0)
                assert made is not None
                start.write(made, anew=True)
                folder.rename(directory)
        except BaseException as error:
            shutil.rmtree(folder, ignore_errors=True)
            if isinstance(error.__cause__, OSError) and error.__cause__.errno in (errno.EEXIST, errno.ENOTEMPTY):
                return None
            raise
        return Ownership(directory, made.number, made.nonce)

    def _take_over(self, directory: Path) -> Ownership | OwnerInfo | None:
        """Ownership of an existing run, or who owns it; None if it was deleted meanwhile."""
        try:
            require_run(directory)
        except StoreError:
            if _is_vacant(directory):
                return None
            raise
        return owner.acquire(directory)


def _is_vacant(directory: Path) -> bool:
    try:
        return not any(directory.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return True


@dataclass
class _Start:
    """The files that a run has before anything is computed."""

    run_id: str
    files: Mapping[str, bytes]

    def write(self, ownership: Ownership, *, anew: bool) -> None:
        """Writes what is missing; anew: all, and deletes the results of an earlier training.

        A kill at any moment leaves a run that goes on, or starts again.
        """
        folder, now = ownership.directory, time.time()
        status = {"run_id": self.run_id, "step": 0, "created": now, "heartbeat": now} | running_status(ownership)
        files = {"status.json": json_bytes(status), **self.files}
        results = (
            [path for path in _results(folder) if path.relative_to(folder).as_posix() not in files] if anew else []
        )
        with reporting(folder):
            for name in ("images", "metrics"):
                (folder / name).mkdir(exist_ok=True)
        for name, data in files.items():
            if anew or not (folder / name).exists():
                ownership.check()
                replace(folder / name, data, temporary_folder=folder, durable=False)
            if anew and name == "status.json":  # without a checkpoint the run starts again after a kill
                _delete(ownership, [*map(folder.joinpath, CHECKPOINTS), *results])


def _results(folder: Path) -> Iterator[Path]:
    """What an earlier training has left beside the checkpoints; what else is in the folder is its user's."""
    yield from map(folder.joinpath, (*RESULTS, *(f"{name}.parquet" for name in PROBES)))
    yield from folder.glob("damaged-*-checkpoint*.pt")
    with contextlib.suppress(StoreError):
        yield from metric_parts(folder).values()
        for name in picture_names(list(read_evaluation(folder)["image"])):
            yield folder / "images" / f"{name}.png"


def _delete(ownership: Ownership, files: Iterable[Path]) -> None:
    with reporting(ownership.directory, "delete the results"):
        for path in list(files):
            ownership.check()
            path.unlink(missing_ok=True)


@contextlib.contextmanager
def _released_on_error(ownership: Ownership) -> Iterator[None]:
    try:
        yield
    except BaseException:
        with contextlib.suppress(StoreError):
            ownership.release()
        raise


def _finished(directory: Path) -> Claim:
    again = "run.force=true does it over; more steps (train.steps=N) are another run, from the start"
    return Claim("finished", directory, f"{directory}: finished already; {again}")


def to_yaml(config: Mapping[str, Any]) -> str:
    content = json.loads(json_bytes(plain(config)))  # of Unicode alone
    readable = "\\x85" not in repr(content)  # a line's end to YAML, which PyYAML writes as it is
    text: str = yaml.safe_dump(content, sort_keys=False, allow_unicode=readable, width=120)
    return text
