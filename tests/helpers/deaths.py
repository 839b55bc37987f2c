"""Writers that are killed before their n-th system call, n = 1, 2, ... until they get through.

python -m tests.helpers.deaths FOLDER EVERY strace|audit [OPERATION ...]

A training (that of `tests.helpers.jobs`) is killed in each of `OPERATIONS`, or in those named, and the next process
finishes it. EVERY is 1 for each call, 3 for each third. `strace` injects the kill before a real system call. `audit`
kills before one of Python's audit events, for systems without strace. Prints one JSON line per round.
"""

import contextlib
import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from qnerf.cli.main import dispatch
from qnerf.records import Run, RunStore
from tests.helpers.jobs import fork, train

CALLS = (
    "openat,write,pwrite64,writev,rename,renameat,renameat2,link,linkat,symlink,symlinkat,unlink,unlinkat,mkdir,mkdirat,"
    "rmdir,fsync,fdatasync,ftruncate,close"
)
"""System calls that change a file, and what goes before and after."""
EVENTS = {"open", "os.rename", "os.link", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "shutil.rmtree"}
EMPTY = {"seed": 0}


class Reached(BaseException):
    """The operation is complete."""


class Shim:
    """Kills this process in its n-th call after `arm`."""

    def __init__(self, kind: str, number: int, ready: int, go: int) -> None:
        self.kind, self.number, self.ready, self.go = kind, number, ready, go

    def arm(self) -> None:
        os.write(self.ready, b"x")
        os.read(self.go, 1)  # strace is there now
        if self.kind != "audit":
            return
        left = self.number  # calls

        def count(event: str, arguments: Any) -> None:
            nonlocal left
            if event in EVENTS:
                left -= 1
                if left == 0:
                    os.kill(os.getpid(), signal.SIGKILL)

        sys.addaudithook(count)

    def at(self, target: Any, name: str, call: int) -> None:
        """Arms itself for the call with this number (from 1) of a method, after which the process ends."""
        original = getattr(target, name)
        calls = 0

        def armed(*arguments: Any, **options: Any) -> Any:
            nonlocal calls
            calls += 1
            if calls != call:
                return original(*arguments, **options)
            setattr(target, name, original)
            self.arm()
            original(*arguments, **options)
            os._exit(0)

        setattr(target, name, armed)


def claimed(store: RunStore) -> Run | None:
    claim = store.claim("walk", EMPTY)
    assert claim.run is not None or claim.outcome == "finished", claim.message
    return claim.run


def train_until(name: str, call: int) -> Callable[[RunStore, Shim], None]:
    """A training that is killed in a call of one of the methods of its `Run`."""

    def operation(store: RunStore, shim: Shim) -> None:
        run = claimed(store)
        assert run is not None
        shim.at(run, name, call)
        train(run, pace=0.0)

    return operation


def release(store: RunStore, shim: Shim) -> None:
    run = claimed(store)
    assert run is not None
    shim.at(run._ownership, "release", 1)
    train(run, pace=0.0)


def claim_new(store: RunStore, shim: Shim) -> None:
    shim.arm()
    claimed(store)


def claim_interrupted(store: RunStore, shim: Shim) -> None:
    interrupted(store)
    shim.arm()
    claimed(store)


def remove(store: RunStore, shim: Shim) -> None:
    interrupted(store)
    shim.arm()
    with contextlib.redirect_stdout(io.StringIO()):
        assert dispatch("rm", ["-y", str(store.root / "walk")]) == 0


def interrupted(store: RunStore) -> None:
    run = claimed(store)
    assert run is not None
    flush, calls = run.flush, 0

    def stopping() -> None:
        nonlocal calls
        calls += 1
        flush()
        if calls == 4:
            raise Reached

    run.flush = stopping  # type: ignore[method-assign]
    try:
        train(run, pace=0.0)
    except Reached:
        run.flush = flush  # type: ignore[method-assign]
        run.interrupt()


OPERATIONS: dict[str, Callable[[RunStore, Shim], None]] = {
    "checkpoint": train_until("save_checkpoint", 2),  # with a flush of the rows
    "flush": train_until("flush", 2),
    "evaluation": train_until("write_eval", 1),
    "finish": train_until("finish", 1),  # rows, summary, status, release
    "summary": train_until("write_summary", 1),
    "release": release,
    "claim of a new run": claim_new,
    "claim of an interrupted run": claim_interrupted,
    "rm": remove,
}


def traced(root: Path, operation: str, number: int, *strace: str) -> bool:
    """Whether the operation was killed; False: it got through. strace: its options; without any, audit events kill."""
    ready, ready_end = os.pipe()
    go_end, go = os.pipe()

    def job() -> None:
        OPERATIONS[operation](RunStore(root, every=60), Shim("" if strace else "audit", number, ready_end, go_end))
        os._exit(0)

    pid = fork(job)
    os.close(ready_end)  # so that reading ends if the child does
    assert os.read(ready, 1) == b"x", f"{operation}: was not reached"
    tracer = None
    if strace:
        command = ["strace", "-qq", "-p", str(pid), *strace]
        tracer = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        while "TracerPid:\t0" in Path(f"/proc/{pid}/status").read_text():
            assert tracer.poll() is None, tracer.communicate()[1]
            time.sleep(0.002)
    os.write(go, b"x")
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    if tracer is not None:
        tracer.communicate(timeout=60)
    for handle in (ready, go, go_end):
        os.close(handle)
    assert code in (0, -signal.SIGKILL), code
    return code != 0


def moments(root: Path, operation: str, kind: str) -> Iterator[tuple[int, list[str]]]:
    """The number of each call, and the options with which strace kills there."""
    if kind == "audit":
        yield from ((number, []) for number in range(1, 1000))
        return
    log = root / "calls.log"
    traced(root / "whole", operation, 0, "-o", str(log), "-e", f"trace={CALLS}")
    counts: Counter[str] = Counter()  # strace counts each kind of call by itself
    for number, name in enumerate(re.findall(r"^(\w+)\(", log.read_text(), re.MULTILINE), start=1):
        counts[name] += 1
        kill = f"inject={name}:signal=KILL:when={counts[name]}"
        yield number, ["-o", os.devnull, "-e", f"trace={name}", "-e", kill]


def resume(root: Path) -> None:
    """What the user does next: the same command; after `rm`, this trains from the start."""
    run = claimed(RunStore(root, every=60))
    if run is not None:
        train(run, pace=0.0)


def main(root: Path, every: int, kind: str, operations: Sequence[str]) -> None:
    import torch

    torch.set_num_threads(1)
    for operation in operations:
        folder = root / operation.replace(" ", "-")
        folder.mkdir()
        for number, strace in moments(folder, operation, kind):
            if (number - 1) % every:
                continue
            store = folder / str(number)
            landed = traced(store, operation, number, *strace)
            code = os.waitstatus_to_exitcode(os.waitpid(fork(lambda store=store: resume(store)), 0)[1])  # type: ignore[misc]
            line = {"operation": operation, "number": number, "killed": landed, "code": code, "store": str(store)}
            print(json.dumps(line), flush=True)
            if not landed:
                break


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3], sys.argv[4:] or list(OPERATIONS))
