"""`device=`: the devices that PyTorch has here, and which job gets which of them."""

import contextlib
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

import torch

AUTO = "auto"
ONLY_BY_NAME = "mps"  # Apple's has no float64, which parts of a step need, so `auto` does not take it
RETRY = 2.0  # seconds between two looks for a free GPU


def known() -> list[str]:
    """The devices of this machine by their full names, such as `cuda:0, cuda:1, cpu`."""
    count = torch.accelerator.device_count()
    kind = torch.accelerator.current_accelerator() if count else None  # PyTorch 2.6 raises where there is none
    return [*(f"{kind.type}:{number}" for number in range(count) if kind), "cpu"]


def device_of(name: str) -> torch.device:
    """The device of that name. `auto` is the first GPU, else the CPU.

    name: as PyTorch takes it, cpu, cuda, cuda:1 or mps; or auto.

    Raises:
        ValueError: this machine has no such device; the message lists those that it has.
    """
    if name == AUTO:
        return torch.device(_gpus()[0] if _gpus() else "cpu")
    if name in ("cpu", "cpu:0"):
        return torch.device("cpu")
    full = name if ":" in str(name) else f"{name}:0"
    if full not in known():
        raise ValueError(f"device={name}: PyTorch has no such device here; known: {', '.join([AUTO, *known()])}")
    return torch.device(name)


@contextlib.contextmanager
def dealt(name: str, note: Callable[[str], None], stopping: Callable[[], bool] = lambda: False) -> Iterator[str]:
    """The device for one job, which no other job of this user on this machine gets by `auto` until the end of `with`.

    With `auto` and without a free GPU it waits for one. A device that the user names is shared where it is taken.

    note: is told what the job waits for. stopping: once it is true, the job waits no longer.

    Raises:
        ValueError: as `device_of`.
    """
    wanted = device_of(name)
    gpus = _gpus() if name == AUTO else [f"{wanted.type}:{wanted.index or 0}"]
    if wanted.type == "cpu":
        yield "cpu"
        return
    with contextlib.ExitStack() as held:
        chosen = next((gpu for gpu in gpus if _take(gpu, held)), None)
        if name != AUTO:
            yield name
            return
        if chosen is None:
            note(f"other jobs have {', '.join(gpus)}; waiting for one. device={gpus[0]} would share it")
        while chosen is None and not stopping():
            time.sleep(RETRY)
            chosen = next((gpu for gpu in gpus if _take(gpu, held)), None)
        yield chosen or gpus[0]


def _gpus() -> list[str]:
    return [name for name in known() if name.partition(":")[0] not in ("cpu", ONLY_BY_NAME)]


def _take(gpu: str, held: contextlib.ExitStack) -> bool:
    """Locks the GPU until `held` is closed; False if another job has it. The lock of a dead process is free."""
    try:
        import fcntl
    except ModuleNotFoundError:  # not a Unix: jobs are not kept apart
        return True
    file: IO[bytes] = _lock(gpu).open("ab")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        return False
    held.enter_context(file)
    return True


def _lock(gpu: str) -> Path:
    """The lock file of a GPU, named by its hardware: a cluster's jobs may all see theirs as cuda:0."""
    kind, _, number = gpu.partition(":")
    module: Any = getattr(torch, kind)
    own = gpu.replace(":", "")
    with contextlib.suppress(AttributeError, RuntimeError, AssertionError):  # a driver that does not tell
        own = str(module.get_device_properties(int(number)).uuid)
    return Path(tempfile.gettempdir()) / f"qnerf-{os.getuid()}-{own}.lock"
