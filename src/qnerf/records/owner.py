"""At most one process writes a run, also after kills, on several machines, and if several start at the same moment.

The folder `owner/` of a run holds numbered files. Whoever holds the highest number owns the run. A file appears whole
and exclusively (by a hard link), so exactly one of several contenders gets the next number. An owner that ends marks
its own file as released; only the holder of a higher number removes files. So numbers only grow, and a contender
cannot mistake a new owner for the dead one that it saw before.

Is an owner alive? On this machine: if a process with the same pid and start time runs and is not a zombie. On another
machine: if it wrote its last heartbeat less than `HEARTBEAT_LIMIT` ago by the clock of the file system, which is read
from a file just written beside it. So no machine's own clock matters.

A writer checks that it still owns the run before every write and stops if it does not. One gap remains: a writer on
another machine that froze for longer than the limit, exactly between this check and its rename, can still put one file
in place.
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

from qnerf.records.files import StoreError, create, read_json, remove_temporary_files, reporting, temporary_path

HEARTBEAT_INTERVAL = 3.0  # seconds between heartbeats
HEARTBEAT_LIMIT = 180.0  # seconds; network file systems may show files a minute late

_HELD, _RELEASED = b'"released": false', b'"released": true '  # of equal length: the file is marked in place
_FILE = re.compile(r"[0-9]{6}\.json")


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
        """None if the record is damaged."""
        try:
            return cls(int(record["pid"]), str(record["host"]), str(record["boot"]), str(record["started"]))
        except (KeyError, TypeError, ValueError):
            return None

    def is_running(self) -> bool | None:
        """None if it is a process of another machine."""
        if not self.boot or (self.boot, self.host) != (_boot_id(), platform.node()):
            return None
        return _start_time(self.pid) == self.started != ""


@dataclass(frozen=True)
class OwnerInfo:
    """Who owns a run, for messages. age_s: seconds since its last sign of life."""

    process: Process | None
    age_s: float

    def __str__(self) -> str:
        age = f"last heartbeat {max(self.age_s, 0):.0f} s ago"
        if self.process is None:
            return f"an unknown process ({age})"
        return f"process {self.process.pid} on {self.process.host} ({age})"


class Ownership:
    """The right to write into a run's folder."""

    def __init__(self, directory: Path, number: int, nonce: str) -> None:
        self.directory = directory
        self.number = number
        self.nonce = nonce
        self._pid = os.getpid()

    @property
    def inherited(self) -> bool:
        """Whether this is a fork of the owner's process, which owns nothing."""
        return os.getpid() != self._pid

    def refuse_fork(self) -> None:
        """StoreError in a fork of the owner's process. It must not even wait for a lock: nobody would release it."""
        if self.inherited:
            what = "is a fork of it, which writes nothing; return the values, and log them there"
            raise StoreError(f"{self.directory}: process {self._pid} writes the run, and process {os.getpid()} {what}")

    def check(self) -> None:
        """StoreError if the folder is gone, another process has taken the run over, or this is a fork of the owner."""
        self.refuse_fork()
        latest = _latest_number(self.directory)
        if latest < 0:
            raise StoreError(f"{self.directory}: the run's folder was removed or moved while the run was writing to it")
        if latest != self.number:
            raise StoreError(f"{self.directory}: the run was taken over by another process; this one stops writing")

    def release(self) -> None:
        path = _owner_file(self.directory, self.number)
        if self.inherited or _read(path).get("nonce") != self.nonce:
            return
        with reporting(path), open(path, "r+b") as file:
            held = file.read().find(_HELD)
            if held >= 0:  # a stop may ask for this twice
                file.seek(held)
                file.write(_RELEASED)  # in place: this must work on a full disk too


def acquire(directory: Path) -> Ownership | OwnerInfo | None:
    """Ownership of a run, or who owns it; None if its folder is gone."""
    for _ in range(1000):
        with reporting(directory, "claim the run"):
            try:
                (directory / "owner").mkdir(exist_ok=True)
                number, before = latest(directory)
                if (holder := living(directory)) is not None:
                    return holder
                ownership = create_owner(directory, number + 1)
                if ownership is None:
                    continue
                if _succeeds(directory, ownership, before):
                    for path in (directory / "owner").glob("*.json"):
                        if path != _owner_file(directory, ownership.number):
                            path.unlink(missing_ok=True)
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
    nonce = secrets.token_hex(8)
    record = asdict(Process.current()) | {"nonce": nonce, "since": time.time(), "released": False}
    created = create(_owner_file(directory, number), json.dumps(record).encode())
    return Ownership(directory, number, nonce) if created else None


def _succeeds(directory: Path, ownership: Ownership, before: Mapping[str, Any]) -> bool:
    """Whether the new number is the highest and follows the owner that was found dead. If not, another contender was
    faster or the folder is a new one."""
    if _latest_number(directory) != ownership.number:
        return False
    return _read(_owner_file(directory, ownership.number - 1)).get("nonce") == before.get("nonce")


def latest(directory: Path) -> tuple[int, dict[str, Any]]:
    """The highest number and its record, which is empty if it cannot be read; -1 if nobody has owned the folder."""
    number = _latest_number(directory)
    return number, _read(_owner_file(directory, number))


def living(directory: Path) -> OwnerInfo | None:
    """The owner of a run; None if nobody owns it or its process is dead."""
    number, record = latest(directory)
    if number < 0 or record.get("released"):
        return None
    process = Process.from_record(record)
    running = None if process is None else process.is_running()
    if running is False:
        return None
    holder = describe(directory)
    return holder if running or holder.age_s <= HEARTBEAT_LIMIT else None


def describe(directory: Path) -> OwnerInfo:
    """Who owns the run, or owned it last."""
    number, record = latest(directory)
    times = [0.0]
    for path in (directory / "status.json", _owner_file(directory, number)):
        with contextlib.suppress(OSError):
            times.append(path.stat().st_mtime)
    return OwnerInfo(Process.from_record(record), _file_system_time(directory) - max(times))


def _file_system_time(directory: Path) -> float:
    """Unix time by the clock of the file system: the time of a file just written. This machine's if none can be."""
    probe = temporary_path(directory / "owner" / "time")
    with contextlib.suppress(OSError):
        try:
            probe.write_bytes(b"")
            return probe.stat().st_mtime
        finally:
            probe.unlink()
    return time.time()


def _latest_number(directory: Path) -> int:
    """The highest number of the owner's files; -1 if there is none."""
    try:
        names = os.listdir(directory / "owner")
    except (FileNotFoundError, NotADirectoryError):
        return -1
    return max((int(name[:6]) for name in names if _FILE.fullmatch(name)), default=-1)


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


def _output(*command: str) -> str:
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=5, check=False).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
