"""Which run a process may write: claimed whole by one rename, skipped when finished, gone on with when interrupted."""

import contextlib
import errno
import json
import os
import re
import secrets
import shutil
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import yaml  # type: ignore[import-untyped]

from qnerf.config.identity import identity, plain
from qnerf.records import owner, schemas
from qnerf.records.files import StoreError, read_bytes, remove_leftovers, replace, reporting
from qnerf.records.owner import Held, Ownership, Process
from qnerf.records.read import read_config, read_status, read_table, runs
from qnerf.records.summary_row import encode as encode_row
from qnerf.records.writer import EMPTY_PART, FORMAT, Run

_RUN_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,199}")


@dataclass(frozen=True)
class Claim:
    """What came of the wish to write a run.

    new: nothing was there. resumed: something was, and nobody alive owns it. finished, busy: nothing to do here, and
    `run` is None; `owner` tells who holds a busy one. `message` says it in one line.
    """

    outcome: Literal["new", "resumed", "finished", "busy"]
    dir: Path
    message: str
    run: Run | None = None
    owner: Held | None = None


class RunStore:
    """A folder of runs; made at the first claim.

    every: seconds between flushes and heartbeats; watch: seconds that the stale heartbeat of a writer on another
    machine is watched before its run is taken over.
    """

    def __init__(self, root: str | Path, *, every: float = owner.HEARTBEAT, watch: float = owner.WATCH) -> None:
        self.root = Path(root)
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
        """Asks for the right to write `run_id`; exactly one of several contenders gets it.

        config: resolved, plain values. overrides: what the user typed. columns: further columns of summary.parquet from
        the start on, as `Run.write_summary` takes them. force: a finished or interrupted run is thrown away and done
        over; the old content goes in one rename. Raises StoreError where the store cannot be written.
        """
        if not _RUN_ID.fullmatch(run_id):
            raise ValueError(f"run_id: expected letters, digits, '.', '_', '-' after a letter or digit, got {run_id!r}")
        content = _Content(run_id, plain(config), list(overrides), dict(columns or {}))
        directory = self.root / run_id
        if not force and read_status(directory).get("state") == "finished":
            return _finished(directory)
        with reporting(self.root):
            (self.root / ".tmp").mkdir(parents=True, exist_ok=True)
        self._tidy(run_id)
        for _ in range(1000):
            _refuse_links(directory)
            if _is_vacant(directory):
                made = self._make(content, 0)
                if (ownership := self._enter(made, directory)) is None:
                    continue
                return Claim("new", directory, f"{directory}: new run", self._open(ownership, resumed=False))
            held = owner.acquire(directory, self.watch)
            if held is None:
                continue
            if isinstance(held, Held):
                return Claim("busy", directory, f"{directory}: already being written by {held}", owner=held)
            before = read_status(directory).get("state")
            if force:
                if (ownership := self._redo(content, held)) is None:
                    continue
                return Claim("new", directory, f"{directory}: done over", self._open(ownership, resumed=False))
            if before == "finished":  # in the meantime
                held.release()
                return _finished(directory)
            try:
                _refuse_newer(directory)
                remove_leftovers(directory)
                content.complete(directory)
            except StoreError:
                held.release()
                raise
            onward = "from its checkpoint" if any(directory.glob("checkpoint*.pt")) else "from the start"
            stored = before if before == "failed" else "interrupted"
            message = f"{directory}: was {stored}, going on {onward}"
            return Claim("resumed", directory, message, self._open(held, resumed=True))
        raise StoreError(f"{directory}: cannot claim the run: its folder comes and goes all the time")

    def _open(self, ownership: Ownership, *, resumed: bool) -> Run:
        try:
            return Run(ownership, resumed=resumed, every=self.every)
        except BaseException:
            with contextlib.suppress(StoreError):
                ownership.release()
            raise

    def _make(self, content: "_Content", number: int) -> Ownership:
        """A complete folder of a run, still under a temporary name."""
        folder = self._temporary("new", content.run_id)
        try:
            with reporting(self.root / content.run_id):
                (folder / "owner").mkdir(parents=True)
                ownership = owner.write(folder, number)
            assert ownership is not None
            content.complete(folder)
            content.write_status(folder, ownership)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        return ownership

    def _enter(self, made: Ownership, directory: Path) -> Ownership | None:
        """Gives a complete folder its name; None when somebody else was faster."""
        try:
            os.rename(made.directory, directory)
        except OSError as error:
            shutil.rmtree(made.directory, ignore_errors=True)
            if error.errno in (errno.EEXIST, errno.ENOTEMPTY):
                return None
            raise StoreError(f"{directory}: cannot create the run's folder: {error.strerror or error}") from error
        return Ownership(directory, made.number, made.nonce)

    def _redo(self, content: "_Content", held: Ownership) -> Ownership | None:
        # The number stays, so that a contender who looked at the old folder cannot become owner of the new one.
        try:
            made = self._make(content, held.number)
        except BaseException:
            with contextlib.suppress(StoreError):
                held.release()
            raise
        with contextlib.suppress(StoreError, OSError):  # tags and note are the user's, not the old results'
            (made.directory / "annotations.json").write_bytes(read_bytes(held.directory / "annotations.json", 2**20))
        trash = self._temporary("old", content.run_id)
        try:
            os.rename(held.directory, trash)
        except OSError as error:
            shutil.rmtree(made.directory, ignore_errors=True)
            with contextlib.suppress(StoreError):
                held.release()
            raise StoreError(f"{held.directory}: cannot be done over: {error.strerror or error}") from error
        try:
            return self._enter(made, held.directory)
        finally:
            shutil.rmtree(trash, ignore_errors=True)

    def _temporary(self, kind: str, run_id: str) -> Path:
        return self.root / ".tmp" / f"{kind}-{run_id}-{secrets.token_hex(4)}"

    def _tidy(self, run_id: str) -> None:
        """What killed processes left of this run: old content that was on its way out, new that never got in."""
        for path in (self.root / ".tmp").glob(f"*-{run_id}-*"):
            with contextlib.suppress(OSError):
                if path.name.startswith("old-") or abs(time.time() - path.stat().st_mtime) > 3600:
                    shutil.rmtree(path, ignore_errors=True)


def _is_vacant(directory: Path) -> bool:
    try:
        return not any(directory.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return True


def _refuse_links(directory: Path) -> None:
    """Nothing is written into a run through a link, wherever it leads."""
    for path in (directory, *(directory / name for name in ("owner", "metrics", "images"))):
        if path.is_symlink():
            raise StoreError(f"{path}: is a link; the files of a run are not read or written through links")


def _refuse_newer(directory: Path) -> None:
    written = read_status(directory).get("format", FORMAT)
    if isinstance(written, int) and written > FORMAT:
        raise StoreError(
            f"{directory}: written by a newer qnerf (store format {written}, this one knows {FORMAT}); "
            "a newer qnerf goes on with it"
        )


def _finished(directory: Path) -> Claim:
    return Claim("finished", directory, f"{directory}: finished already; run.force=true does it over")


class _Content:
    """What a run's folder holds before anything was computed."""

    def __init__(self, run_id: str, config: dict[str, Any], overrides: list[str], columns: dict[str, Any]) -> None:
        self.run_id = run_id
        self.config = config
        self.overrides = overrides
        self.columns = columns

    def complete(self, folder: Path) -> None:
        """Writes what is missing or damaged."""

        def put(name: str, data: bytes) -> None:
            replace(folder / name, data, durable=False)

        with reporting(folder):
            (folder / "images").mkdir(exist_ok=True)
            if not _readable(read_config, folder):
                put("config.yaml", to_yaml(self.config).encode())
            if not (folder / "overrides.txt").exists():
                put("overrides.txt", "".join(f"{line}\n" for line in self.overrides).encode())
            if not _readable(read_table, folder / "eval.parquet"):
                put("eval.parquet", schemas.encode(schemas.evaluation([], 0)))
            if not _readable(read_table, folder / "summary.parquet"):
                row = self.columns | {"run_id": self.run_id, "state": "running"}
                put("summary.parquet", encode_row(schemas.summary(row, self.config)))
            if not (folder / "metrics").is_dir():
                temporary = folder / f".metrics.{secrets.token_hex(4)}.tmp"
                temporary.mkdir()
                (temporary / "part-00000.parquet").write_bytes(EMPTY_PART)
                os.rename(temporary, folder / "metrics")

    def write_status(self, folder: Path, ownership: Ownership) -> None:
        now = time.time()
        status = {"run_id": self.run_id, "state": "running", "step": 0, "heartbeat": now, "created": now}
        status |= asdict(Process.current()) | {"claim": ownership.nonce, "error": None, "format": FORMAT}
        status["config"] = identity(self.config)  # tells a configuration edited by hand from a scene that has changed
        replace(folder / "status.json", json.dumps(status, indent=1).encode(), durable=False)


def _readable(reader: Any, path: Path) -> bool:
    try:
        reader(path)
    except StoreError:
        return False
    return True


class _Dumper(yaml.SafeDumper):
    """Quotes text such as 1e-2, which YAML 1.1 takes for text and others for a number, and unusual characters."""


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
