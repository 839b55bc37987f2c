"""How long the stages of a training step take, and what makes such times comparable."""

import hashlib
import os
import platform
import statistics
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import nn

try:
    import resource
except ImportError:  # not a Unix
    resource = None  # type: ignore[assignment]

STAGES = ("sampling", "field", "quantum", "render", "backward", "optimiser")


class Stopwatch:
    """Adds up the seconds that a step spends in each of `STAGES`.

    `quantum` is the forward time of the modules of type `circuits`. It is contained in the other stages, mostly in
    `field`. On a CUDA device every measurement waits for the device, which slows the step down: only steps that begin
    with `measure` are timed.
    """

    def __init__(self, device: torch.device, model: nn.Module, circuits: type[nn.Module]) -> None:
        self.device = device
        self.active = False
        self.seconds = dict.fromkeys(STAGES, 0.0)
        for module in model.modules():
            if isinstance(module, circuits):
                module.register_forward_pre_hook(self._enter_circuit)
                module.register_forward_hook(self._leave_circuit)

    def begin(self, measure: bool) -> None:
        """Starts a new step and sets all stages to 0; they are timed only if `measure`."""
        self.active = measure
        self.seconds = dict.fromkeys(STAGES, 0.0)

    def now(self, wait: bool = True) -> float:
        """Seconds on a monotonic clock; if `wait`, after the device has finished its work."""
        if wait and self.device.type != "cpu":
            torch.accelerator.synchronize(self.device)
        return time.perf_counter()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Times the body of the `with` statement."""
        if not self.active:
            yield
            return
        start = self.now()
        yield
        self.seconds[name] += self.now() - start

    def _enter_circuit(self, *_: object) -> None:
        self._start = self.now() if self.active else 0.0

    def _leave_circuit(self, *_: object) -> None:
        if self.active:
            self.seconds["quantum"] += self.now() - self._start


def median_ms(seconds: list[float], skip: int = 50) -> float:
    """Median in milliseconds without the first `skip` steps; of all steps if there are no more than that.

    >>> median_ms([9.0, 1.0, 2.0, 3.0], skip=1)
    2000.0
    """
    counted = seconds[skip:] or seconds
    return statistics.median(counted) * 1e3 if counted else float("nan")


def load() -> float:
    """Processes that run or wait for a core, over the last minute, for each core of the machine; NaN where unknown.

    At most 1 where every process has a core of its own.
    """
    try:
        return os.getloadavg()[0] / (os.cpu_count() or 1)
    except (AttributeError, OSError):  # not a Unix
        return float("nan")


def machine(device: torch.device) -> str:
    """A short name for this machine and its device: the same in all runs that share them, and it tells neither."""
    kind = torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor()
    return hashlib.sha256(f"{platform.node()} {kind} {device.type}".encode()).hexdigest()[:8]


def peak_memory_mb(device: torch.device) -> float:
    """Peak memory in MiB: the allocator's on CUDA, else the resident set of the process (NaN where unknown)."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    if resource is None:
        return float("nan")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)
