"""At most one process writes a run, also after kills, on several machines, and if several start at the same moment.

The folder `owner/` of a run holds numbered files. Whoever holds the highest number owns the run. A file appears whole
and exclusively (by a hard link), so exactly one of several contenders gets the next number. An owner that ends marks
its own file as released; only the holder of a higher number removes files. So numbers only grow, and a contender
cannot mistake a new owner for the dead one that it saw before.

Is an owner alive? On this machine: if a process with the same pid and start time runs and is not a zombie. On another
machine: if its heartbeat is younger than `HEARTBEAT_LIMIT`. A heartbeat that looks old is watched for a while before
the run is taken over, because clocks may disagree. A writer checks that it still owns the run before every write and
stops if it does not. One gap remains: a writer on another machine that froze for longer than the limit, exactly
between this check and its rename, can still put one file in place.
"""

import contextlib
import json
import os
import platform
import secrets
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from qnerf.records import files
from qnerf.records.files import StoreError, read_json, reporting
from qnerf.records.numbered import OWNERS

HEARTBEAT_INTERVAL = 3.0  # seconds between heartbeats
HEARTBEAT_LIMIT = 180.0  # seconds; network file systems may show files a minute late
WATCH_TIME = 4 * HEARTBEAT_INTERVAL  # seconds that an old heartbeat is watched before the run is taken over

_HELD, _RELEASED = b'"released": false', b'"released": true '  # of equal length: the file is marked in place
_released_nonces: set[str] = set()  # claims released by this process, in case a broken disk refused the mark


@dataclass(frozen=True)
class Process:
    """A process, told apart from later ones with the same pid by its start time and the boot of the machine."""

    pid: int
    host: str
    boot: str  # identifies the boot of the machine and the pid namespace
    started: str  # start time as the system reports it, not as a date: the clock may be set

    @classmethod
    def current(cls) -> "Process":
        return cls(os.getpid(), platform.node(), _boot_id(), _start_time(os.getpid()))

    @classmethod
    def from_record(cls, record: dict[str, Any]) -> "Process | None":
        try:
            pid = int(record["pid"])
            return cls(pid, str(record["host"]), str(record["boot"]), str(record["started"])) if pid > 0 else None
        except (KeyError, TypeError, ValueError, OverflowError):
            return None

    def is_running(self) -> bool | None:
        """None if it is a process of another machine, or of another user and hidden by the system."""
        if not self.boot or (self.boot, self.host) != (_boot_id(), platform.node()):
            return None
        started = _start_time(self.pid)
        if not started and _is_hidden(self.pid):
            return None
        return bool(started) and started == self.started


@dataclass(frozen=True)
class OwnerInfo:
    """Who owns a run, for messages."""

    pid: int | None
    host: str | None

    @classmethod
    def from_record(cls, record: dict[str, Any]) -> "OwnerInfo":
        process = Process.from_record(record)
        host = None if process is None else "".join(c if c.isprintable() else "?" for c in process.host[:64])
        return cls(process.pid if process else None, host)

    def __str__(self) -> str:
        where = "this machine" if self.host == platform.node() else self.host or "an unknown machine"
        return f"process {self.pid if self.pid is not None else '?'} on {where}"


class Ownership:
    """The right to write into a run's folder."""

    def __init__(self, directory: Path, number: int, nonce: str) -> None:
        self.directory = directory
        self.number = number
        self.nonce = nonce

    def check(self) -> None:
        """StoreError if the folder is gone or another process has taken the run over."""
        try:
            number, _ = latest(self.directory)
        except FileNotFoundError:
            number = -1
        if number < 0:
            raise StoreError(f"{self.directory}: the run's folder was removed or moved while the run was writing to it")
        if number != self.number:
            raise StoreError(f"{self.directory}: the run was taken over by another process; this one stops writing")

    def release(self) -> None:
        _released_nonces.add(self.nonce)
        path = _owner_file(self.directory, self.number)
        if _read(path).get("nonce") != self.nonce:
            return
        with reporting(path), files.open_plain(path, "r+b", max_bytes=files.MAX_JSON_BYTES) as file:
            position = file.read().find(_HELD)
            if position >= 0:
                file.seek(position)
                file.write(_RELEASED)  # in place: this must work on a full disk too


def is_alive(record: dict[str, Any], heartbeat: float | None) -> bool:
    """Whether the process in `record` (pid, host, boot, started) runs. heartbeat: Unix time."""
    process = Process.from_record(record)
    running = process.is_running() if process else None
    return is_recent(heartbeat) if running is None else running


def is_recent(heartbeat: float | None) -> bool:
    """Whether a heartbeat (Unix time) is within `HEARTBEAT_LIMIT`. One far in the future is as old as one in the past:
    the clock has been set back since."""
    return heartbeat is not None and abs(time.time() - heartbeat) <= HEARTBEAT_LIMIT


def acquire(directory: Path, watch: float = WATCH_TIME) -> Ownership | OwnerInfo | None:
    """Ownership of an existing run, or who owns it; None if there is no such folder (any more).

    watch: seconds that an old heartbeat of an owner on another machine is watched.
    """
    for _ in range(1000):
        with reporting(directory, "claim the run"):
            try:
                files.make_folder(directory / "owner")
                number, record = latest(directory)
                if record is not None and not _is_released(record) and _is_active(directory, number, record, watch):
                    return OwnerInfo.from_record(record)
                ownership = create(directory, number + 1)
                if ownership is None:
                    continue
                if _succeeds(directory, ownership, record):
                    _remove_older(directory, ownership.number)
                    # A contender whose temporary file goes finds the run owned when it tries again.
                    files.remove_temporary_files(directory / "owner")
                    return ownership
                files.delete(_owner_file(directory, ownership.number), ignore_errors=True)
            except FileNotFoundError:
                if not files.exists(directory, root=directory.parent):
                    return None
    raise StoreError(f"{directory}: cannot claim the run: its owner changes all the time")


def create(directory: Path, number: int) -> Ownership | None:
    """Creates owner file `number`, exclusively and whole; None if it exists."""
    path = _owner_file(directory, number)
    if OWNERS.number(path.name) is None:
        raise StoreError(f"{path.parent}: there is no number after {number - 1}; delete this folder")
    nonce = secrets.token_hex(8)
    record = asdict(Process.current()) | {"nonce": nonce, "since": time.time(), "released": False}
    return Ownership(directory, number, nonce) if files.create(path, json.dumps(record).encode()) else None


def latest(directory: Path) -> tuple[int, dict[str, Any] | None]:
    """The highest number and its record, which is empty if it cannot be read; (-1, None) if there is none."""
    number = max(_numbers(directory), default=-1)
    return number, None if number < 0 else _read(_owner_file(directory, number))


def describe(directory: Path) -> OwnerInfo:
    """Who owns the run, or owned it last."""
    return OwnerInfo.from_record(latest(directory)[1] or {})


def last_heartbeat(directory: Path, record: dict[str, Any]) -> float | None:
    """Last sign of life of the owner in `record`, in Unix time."""
    status = _read(directory / "status.json")
    value = status.get("heartbeat") if status.get("claim") == record.get("nonce") else record.get("since")
    return unix_time(value)


MAX_TIME = 253_402_300_799.0  # Unix time of the end of the year 9999, the last that a date can hold


def unix_time(value: Any) -> float | None:
    """A time from a file that anybody may have written; None if it is no number from 0 to `MAX_TIME`."""
    is_time = isinstance(value, (int, float)) and 0 <= value <= MAX_TIME
    return float(value) if is_time else None


def _is_released(record: dict[str, Any]) -> bool:
    return bool(record.get("released")) or str(record.get("nonce")) in _released_nonces


def _is_active(directory: Path, number: int, record: dict[str, Any], watch: float) -> bool:
    """Whether the owner in `record` lives. If only the clock says that it does not, it is watched for a sign of life:
    a heartbeat that changes, to whatever time, or a change of its owner file."""
    process = Process.from_record(record)
    running = None if process is None else process.is_running()
    if running is not None:
        return running

    def sign() -> tuple[float | None, int, dict[str, Any] | None]:
        if process is not None:
            return last_heartbeat(directory, record), *latest(directory)
        # damaged, or still being written on a file system without hard links
        return files.status(_owner_file(directory, number)).st_mtime, *latest(directory)

    first = sign()
    if is_recent(first[0]):
        return True
    end = time.monotonic() + watch
    while time.monotonic() < end:
        time.sleep(min(0.2, watch))
        if sign() != first:
            return True
    return False


def _succeeds(directory: Path, ownership: Ownership, before: dict[str, Any] | None) -> bool:
    """Whether the new number is the highest and follows the owner that was found dead. If not, another contender was
    faster or the folder is a new one."""
    if max(_numbers(directory), default=-1) != ownership.number:
        return False
    previous = _read(_owner_file(directory, ownership.number - 1))
    return before is None or previous.get("nonce") == before.get("nonce")


def _remove_older(directory: Path, number: int) -> None:
    for older in sorted(_numbers(directory)):
        if older < number:
            files.delete(_owner_file(directory, older), ignore_errors=True)


def _numbers(directory: Path) -> list[int]:
    return list(OWNERS.in_folder(directory / "owner"))


def _owner_file(directory: Path, number: int) -> Path:
    return directory / "owner" / OWNERS.name(number)


def _read(path: Path) -> dict[str, Any]:
    """Empty if the file cannot be read."""
    try:
        return read_json(path)
    except (OSError, ValueError):
        return {}


@lru_cache(maxsize=1)
def _boot_id() -> str:
    """This boot of this machine and its pid namespace; empty if the system does not tell."""
    with contextlib.suppress(OSError):
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot}/{os.readlink('/proc/self/ns/pid')}"
    if sys.platform == "darwin":
        return _output("sysctl", "-n", "kern.bootsessionuuid")
    return ""


def _start_time(pid: int) -> str:
    """Of a running process; empty for a zombie, no process, or an unknown system.

    psutil gives a date instead, which moves when the clock is set: a living owner would look like another process.
    """
    if sys.platform.startswith("linux"):
        try:
            stat = Path(f"/proc/{pid}/stat").read_text(errors="replace")
        except OSError:
            return ""
        state, *fields = stat.rpartition(")")[2].split()
        return "" if state in "ZX" else fields[18]
    if sys.platform == "darwin":
        return _output("ps", "-o", "lstart=", "-p", str(pid))
    return ""


def _is_hidden(pid: int) -> bool:
    """Whether there is a process that only its own user may look at."""
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
