"""One owner a run, also after kills, on several machines, and with contenders in the same microsecond.

`owner/` in a run's folder holds numbered files; the holder of the highest number owns the run. A file appears whole and
exclusively (hard link), so of several contenders for the next number exactly one gets it. An owner that lets go marks
its own file; files are removed only by the holder of a higher number, hence numbers only grow and nobody mistakes a new
owner for the stale one it saw before.

An owner on this machine is alive while its process is: same pid, same start time, not a zombie. An owner elsewhere is
alive while its heartbeat is younger than `HEARTBEAT_LIMIT`; before it is succeeded the heartbeat is watched for a
while, so that clocks that disagree do no harm. A writer looks whether it still owns the run before every flush and
stops if not; one that was frozen on another machine for longer than the limit could, within that look and its rename,
still put one file of its own in place.
"""

import contextlib
import json
import os
import platform
import re
import secrets
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from qnerf.records.files import StoreError, read_record, reporting

HEARTBEAT = 3.0  # seconds between heartbeats
HEARTBEAT_LIMIT = 180.0  # seconds; network file systems may show files a minute late
WATCH = 4 * HEARTBEAT  # seconds that a stale heartbeat is watched before a run elsewhere is taken over

_HOLDS, _LETS_GO = b'"released": false', b'"released": true '
_NAME = re.compile(r"(\d{6,})\.json")
_let_go: set[str] = set()  # nonces of this process, which lives on: the mark in the file may have met a broken disk


@dataclass(frozen=True)
class Process:
    """A process that no other is mistaken for: pids are used again, start times on one boot are not."""

    pid: int
    host: str
    boot: str  # identifier of this boot of the machine and of the pid namespace
    started: str  # start time of the process in the system's own words

    @classmethod
    def current(cls) -> "Process":
        return _process(os.getpid())

    @classmethod
    def read(cls, record: dict[str, Any]) -> "Process | None":
        try:
            pid = int(record["pid"])
            return cls(pid, str(record["host"]), str(record["boot"]), str(record["started"])) if pid > 0 else None
        except (KeyError, TypeError, ValueError, OverflowError):
            return None

    def is_here(self) -> bool:
        return bool(self.boot) and self.boot == _boot() and self.host == platform.node()

    def runs_here(self) -> bool | None:
        """Whether a process of this machine (`is_here`) still runs; None when another user's processes are hidden."""
        started = _started(self.pid)
        if not started and _is_hidden(self.pid):
            return None
        return bool(started) and started == self.started


@dataclass(frozen=True)
class Held:
    """Somebody else's claim, as one line tells it."""

    pid: int | None
    host: str | None
    since: float | None  # Unix time

    def __str__(self) -> str:
        where = "this machine" if self.host == platform.node() else self.host or "an unknown machine"
        return f"process {self.pid if self.pid is not None else '?'} on {where}"


class Ownership:
    """The right to write into one run's folder."""

    def __init__(self, directory: Path, number: int, nonce: str) -> None:
        self.directory = directory
        self.number = number
        self.nonce = nonce

    def check(self) -> None:
        """StoreError when the folder is gone or the run has another owner by now."""
        try:
            number, _ = newest(self.directory)
        except FileNotFoundError:
            number = -1
        if number < 0:
            raise StoreError(f"{self.directory}: the run's folder was removed or moved while the run was writing to it")
        if number != self.number:
            raise StoreError(f"{self.directory}: the run was taken over by another process; this one stops writing")

    def release(self) -> None:
        _let_go.add(self.nonce)
        path = _path(self.directory, self.number)
        if (_read(path) or {}).get("nonce") != self.nonce:
            return
        with reporting(path), open(path, "r+b") as file:  # in place: this must work on a full disk too
            file.seek(file.read().index(_HOLDS))
            file.write(_LETS_GO)


def alive(record: dict[str, Any], heartbeat: float | None) -> bool:
    """Whether the process in `record` (pid, host, boot, started) still runs; `heartbeat` in Unix time."""
    process = Process.read(record)
    if process is not None and process.is_here() and (runs := process.runs_here()) is not None:
        return runs
    # A heartbeat far in the future is as stale as one in the past: the clock it was taken from has been set back since.
    return heartbeat is not None and abs(time.time() - heartbeat) <= HEARTBEAT_LIMIT


def acquire(directory: Path, watch: float = WATCH) -> Ownership | Held | None:
    """Ownership of an existing run, or who holds it; None when the folder is not there (any more)."""
    for _ in range(1000):
        try:
            (directory / "owner").mkdir(exist_ok=True)
            number, record = newest(directory)
            if record is not None and not _is_released(record) and _is_held(directory, number, record, watch):
                return _held(record)
            won = write(directory, number + 1)
            if won is None:
                continue
            if not _follows(directory, won, record):
                _path(directory, won.number).unlink(missing_ok=True)
                continue
            _remove_older(directory, won.number)
            return won
        except FileNotFoundError:
            if not directory.is_dir():
                return None
        except OSError as error:
            raise StoreError(f"{directory}: cannot claim the run: {error.strerror or error}") from error
    raise StoreError(f"{directory}: cannot claim the run: its owner changes all the time")


def write(directory: Path, number: int) -> Ownership | None:
    """Owner file `number`, created exclusively and whole; None when there is one already."""
    path = _path(directory, number)
    nonce = secrets.token_hex(8)
    record = asdict(Process.current()) | {"nonce": nonce, "since": time.time(), "released": False}
    data = json.dumps(record).encode()
    temporary = path.with_name(f".{path.name}.{nonce}.tmp")
    temporary.write_bytes(data)
    try:
        try:
            os.link(temporary, path)
        except FileExistsError:
            # A network file system may repeat a request that had succeeded: the link count knows.
            return Ownership(directory, number, nonce) if temporary.stat().st_nlink == 2 else None
        except FileNotFoundError:
            raise
        except OSError:  # no hard links here
            try:
                handle = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
            except FileExistsError:
                return None
            with os.fdopen(handle, "wb") as file:
                file.write(data)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()
    return Ownership(directory, number, nonce)


def newest(directory: Path) -> tuple[int, dict[str, Any] | None]:
    """Highest number and its record (empty when unreadable); (-1, None) when there is none."""
    numbers = [int(match[1]) for name in os.listdir(directory / "owner") if (match := _NAME.fullmatch(name))]
    if not numbers:
        return -1, None
    return max(numbers), _read(_path(directory, max(numbers))) or {}


def heartbeat(directory: Path, record: dict[str, Any]) -> float | None:
    """Last sign of life of the owner in `record`, Unix time."""
    status = _read(directory / "status.json") or {}
    value = status.get("heartbeat") if status.get("claim") == record.get("nonce") else record.get("since")
    return moment(value)


def moment(value: Any) -> float | None:
    """A Unix time out of a file that anybody may have written; None where it is none."""
    try:
        return float(value) if isinstance(value, (int, float)) else None
    except OverflowError:
        return None


def holder(directory: Path) -> Held:
    """Who owns the run, or did last."""
    _, record = newest(directory)
    return _held(record or {})


def _is_released(record: dict[str, Any]) -> bool:
    return bool(record.get("released")) or str(record.get("nonce")) in _let_go


def _is_held(directory: Path, number: int, record: dict[str, Any], watch: float) -> bool:
    process = Process.read(record)
    if process is None:  # being written by one of those file systems without hard links, or damaged
        with contextlib.suppress(OSError):
            return abs(time.time() - _path(directory, number).stat().st_mtime) <= HEARTBEAT_LIMIT
        return True
    last = heartbeat(directory, record)
    if alive(record, last):
        return True
    if process.is_here() and process.runs_here() is False:
        return False
    end = time.monotonic() + watch
    while time.monotonic() < end:
        time.sleep(min(0.2, watch))
        if heartbeat(directory, record) != last:
            return True
    return False


def _held(record: dict[str, Any]) -> Held:
    process = Process.read(record)
    host = None if process is None else "".join(c if c.isprintable() else "?" for c in process.host[:64])
    return Held(process.pid if process else None, host, moment(record.get("since")))


def _follows(directory: Path, won: Ownership, before: dict[str, Any] | None) -> bool:
    """Whether the new number is the highest and stands on the owner that was judged; else the folder was redone."""
    highest, _ = newest(directory)
    if highest != won.number:
        return False
    return before is None or (_read(_path(directory, won.number - 1)) or {}).get("nonce") == before.get("nonce")


def _remove_older(directory: Path, number: int) -> None:
    for name in sorted(os.listdir(directory / "owner")):
        match = _NAME.fullmatch(name)
        if match and int(match[1]) < number:
            with contextlib.suppress(OSError):
                (directory / "owner" / name).unlink()


def _path(directory: Path, number: int) -> Path:
    return directory / "owner" / f"{number:06d}.json"


def _read(path: Path) -> dict[str, Any] | None:
    try:
        return read_record(path)
    except (OSError, ValueError):
        return None


@lru_cache(maxsize=8)
def _process(pid: int) -> Process:
    return Process(pid, platform.node(), _boot(), _started(pid))


@lru_cache(maxsize=1)
def _boot() -> str:
    """This boot of this machine and the namespace its pids count in; empty where it cannot be told."""
    with contextlib.suppress(OSError):
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot}/{os.readlink('/proc/self/ns/pid')}"
    if sys.platform == "darwin":
        return _output("sysctl", "-n", "kern.bootsessionuuid")
    return ""


def _started(pid: int) -> str:
    """Start time of a running process; empty when there is none, it is a zombie, or it cannot be told."""
    if sys.platform.startswith("linux"):
        try:
            stat = Path(f"/proc/{pid}/stat").read_text(errors="replace")
        except OSError:
            return ""
        state, *rest = stat.rpartition(")")[2].split()
        return "" if state in "ZX" else rest[18]
    if sys.platform == "darwin":
        return _output("ps", "-o", "lstart=", "-p", str(pid))
    return ""


def _is_hidden(pid: int) -> bool:
    """Whether there is a process that only its owner may look at."""
    if os.name != "posix":
        return False
    try:
        os.kill(pid, 0)
    except PermissionError:
        return True
    except (OSError, OverflowError):
        return False
    return False


def _output(*command: str) -> str:
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=5, check=False).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
