"""At most one process writes a run, also after kills, on several machines, and if several start at the same moment.

The folder `owner/` of a run holds numbered files. Whoever holds the highest number owns the run. A file appears whole
and exclusively (by a hard link), so exactly one of several contenders gets the next number. An owner that ends marks
its own file as released; only the holder of a higher number removes files. So numbers only grow, and a contender
cannot mistake a new owner for the dead one that it saw before.

Is an owner alive? On this machine: if a process with the same pid and start time runs and is not a zombie. On another
machine: if it wrote its last heartbeat less than `HEARTBEAT_LIMIT` ago by the clock of the file system, which is read
from a file just written beside it. So no machine's own clock matters. An old heartbeat is watched for a while before
the run is taken over. A writer
checks that it still owns the run before every write and stops if it does not. One gap remains: a writer on another
machine that froze for longer than the limit, exactly between this check and its rename, can still put one file in
place.
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
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from qnerf.records.files import (
    StoreError,
    create,
    read_json,
    refuse_links,
    remove_temporary_files,
    reporting,
    temporary_path,
)

HEARTBEAT_INTERVAL = 3.0  # seconds between heartbeats
HEARTBEAT_LIMIT = 180.0  # seconds; network file systems may show files a minute late
WATCH_TIME = 4 * HEARTBEAT_INTERVAL  # seconds that an old heartbeat is watched before the run is taken over

_HELD, _RELEASED = b'"released": false', b'"released": true '  # of equal length: the file is marked in place
_released_nonces: set[str] = set()  # claims that this process released, in case a broken disk refused the mark
_NUMBER = re.compile(r"([0-9]{6,9})\.json")


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
    def from_record(cls, record: Mapping[str, Any]) -> "Process | None":
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
    """Who owns a run, for messages. age_s: seconds since its last sign of life."""

    process: Process | None
    age_s: float

    def __str__(self) -> str:
        age = f"last heartbeat {max(self.age_s, 0):.0f} s ago"
        if self.process is None:
            return f"an unknown process ({age})"
        host = "".join(c if c.isprintable() else "?" for c in self.process.host[:64])
        (kernel, _, space), (own, _, own_space) = (boot.partition("/") for boot in (self.process.boot, _boot_id()))
        container = " in another container" if kernel == own and space != own_space else ""
        return f"process {self.process.pid} on {host}{container} ({age})"


class Ownership:
    """The right to write into a run's folder."""

    def __init__(self, directory: Path, number: int, nonce: str) -> None:
        self.directory = directory
        self.number = number
        self.nonce = nonce

    def check(self) -> None:
        """StoreError if the folder is gone or another process has taken the run over."""
        numbers = _numbers(self.directory)
        if not numbers:
            raise StoreError(f"{self.directory}: the run's folder was removed or moved while the run was writing to it")
        if max(numbers) != self.number:
            raise StoreError(f"{self.directory}: the run was taken over by another process; this one stops writing")

    def release(self) -> None:
        _released_nonces.add(self.nonce)
        path = _owner_file(self.directory, self.number)
        if _read(path).get("nonce") != self.nonce:
            return
        with reporting(path), open(path, "r+b") as file:
            position = file.read().find(_HELD)
            if position >= 0:
                file.seek(position)
                file.write(_RELEASED)  # in place: this must work on a full disk too


def acquire(directory: Path, watch: float = WATCH_TIME) -> Ownership | OwnerInfo | None:
    """Ownership of an existing run, or who owns it; None if there is no such folder (any more).

    watch: seconds that an old heartbeat of an owner on another machine is watched.
    """
    refuse_links(directory, directory / "owner")
    for _ in range(1000):
        with reporting(directory, "claim the run"):
            try:
                (directory / "owner").mkdir(exist_ok=True)
                number, record = latest(directory)
                if record is not None and not _is_released(record):
                    holder = _living_owner(directory, watch)
                    if holder is not None:
                        return holder
                ownership = create_owner(directory, number + 1)
                if ownership is None:
                    continue
                if _succeeds(directory, ownership, record):
                    for older in _numbers(directory) - {ownership.number}:
                        _owner_file(directory, older).unlink(missing_ok=True)
                    # A contender whose temporary file goes finds the run owned when it tries again.
                    remove_temporary_files(directory / "owner")
                    return ownership
                _owner_file(directory, ownership.number).unlink(missing_ok=True)
            except FileNotFoundError:
                if not directory.exists():
                    return None
    raise StoreError(f"{directory}: cannot claim the run: its owner changes all the time")


def create_owner(directory: Path, number: int) -> Ownership | None:
    """Creates owner file `number`, exclusively and whole; None if it exists."""
    path = _owner_file(directory, number)
    nonce = secrets.token_hex(8)
    record = asdict(Process.current()) | {"nonce": nonce, "since": time.time(), "released": False}
    return Ownership(directory, number, nonce) if create(path, json.dumps(record).encode()) else None


def latest(directory: Path) -> tuple[int, dict[str, Any] | None]:
    """The highest number and its record, which is empty if it cannot be read; (-1, None) if nobody owned it."""
    number = max(_numbers(directory), default=-1)
    return number, None if number < 0 else _read(_owner_file(directory, number))


def describe(directory: Path) -> OwnerInfo:
    """Who owns the run, or owned it last."""
    return OwnerInfo(Process.from_record(latest(directory)[1] or {}), _age(directory))


def is_owned(directory: Path) -> bool:
    """Whether the run's last owner has not released it; it may be dead."""
    record = latest(directory)[1]
    return record is not None and not _is_released(record)


def _is_released(record: dict[str, Any]) -> bool:
    return bool(record.get("released")) or str(record.get("nonce")) in _released_nonces


def was_owned(directory: Path) -> bool:
    """Whether the last file of `owner/` is a record that this module wrote."""
    record = latest(directory)[1] or {}
    return "nonce" in record and "released" in record and Process.from_record(record) is not None


def is_alive(directory: Path, status: Mapping[str, Any]) -> bool:
    """Whether the process that wrote `status`, a run's status.json, runs; for readers, who do not watch it."""
    process = Process.from_record(status)
    running = process.is_running() if process else None
    return _age(directory) <= HEARTBEAT_LIMIT if running is None else running


def unix_time(value: Any) -> float | None:
    """A time from a file; None if it is no number that a date can hold."""
    is_time = isinstance(value, (int, float)) and 0 <= value < 253_402_300_800  # the year 10000
    return float(value) if is_time else None


def _living_owner(directory: Path, watch: float) -> OwnerInfo | None:
    """The owner, if it lives. If only its age says that it does not, it is watched for a sign of life: a change of
    status.json or of `owner/`."""
    holder = describe(directory)
    running = None if holder.process is None else holder.process.is_running()
    if running is not None:
        return holder if running else None
    first = _signs(directory)
    end = time.monotonic() + watch
    while holder.age_s > HEARTBEAT_LIMIT and time.monotonic() < end:
        time.sleep(min(0.2, watch))
        if _signs(directory) != first:
            holder = OwnerInfo(holder.process, 0.0)
    return holder if holder.age_s <= HEARTBEAT_LIMIT else None


def _signs(directory: Path) -> tuple[Any, ...]:
    # Reading a file makes a network file system look at it again.
    return _read(directory / "status.json"), *latest(directory), _last_sign(directory)


def _last_sign(directory: Path) -> float:
    """When status.json or the owner's file was written last, by the clock of the file system; 0 if neither exists."""
    times = [0.0]
    for path in (directory / "status.json", _owner_file(directory, max(_numbers(directory), default=0))):
        with contextlib.suppress(OSError):
            times.append(path.stat().st_mtime)
    return max(times)


def _age(directory: Path) -> float:
    """Seconds since the owner's last sign of life, by the clock of the file system."""
    minute = int(time.time() // 60), int(time.monotonic() // 60)  # measured again where this machine's clock is set
    return time.time() + _clock_offset(directory, minute) - _last_sign(directory)


@lru_cache(maxsize=64)
def _clock_offset(directory: Path, minute: tuple[int, int]) -> float:
    """By how many seconds the clock of the file system is ahead of this machine's: by the time of a file just written.

    0 where nothing can be written.
    """
    probe = temporary_path(directory / "owner" / "time")
    with contextlib.suppress(OSError):
        try:
            probe.write_bytes(b"")
            return probe.stat().st_mtime - time.time()
        finally:
            probe.unlink()
    return 0.0


def _succeeds(directory: Path, ownership: Ownership, before: dict[str, Any] | None) -> bool:
    """Whether the new number is the highest and follows the owner that was found dead. If not, another contender was
    faster or the folder is a new one."""
    if max(_numbers(directory), default=-1) != ownership.number:
        return False
    previous = _read(_owner_file(directory, ownership.number - 1))
    return before is None or previous.get("nonce") == before.get("nonce")


def _numbers(directory: Path) -> set[int]:
    """The numbers of the owner's files; other names, such as the copies of a sync program, are left out."""
    try:
        names = os.listdir(directory / "owner")
    except (FileNotFoundError, NotADirectoryError):
        return set()
    numbers = {int(match[1]) for match in map(_NUMBER.fullmatch, names) if match}
    return {number for number in numbers if _owner_file(directory, number).name in names}


def _owner_file(directory: Path, number: int) -> Path:
    return directory / "owner" / f"{number:06d}.json"


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
    return _output("sysctl", "-n", "kern.bootsessionuuid") if sys.platform == "darwin" else ""


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
    return _output("ps", "-o", "lstart=", "-p", str(pid)) if sys.platform == "darwin" else ""


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
