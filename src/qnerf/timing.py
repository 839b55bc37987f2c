"""Where a training step's time goes."""

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

PARTS = ("sampling", "field", "quantum", "render", "backward", "optimiser")


class Stopwatch:
    """Adds up the seconds of a step's parts; `quantum` is the circuits' share of them, of `field` above
    all.

    On a CUDA device a part is timed to its completion, which serialises host and device: only the steps for which
    `begin` was asked to watch are measured.
    """

    def __init__(self, device: torch.device, model: nn.Module, circuits: type[nn.Module]) -> None:
        self.device = device
        self.active = False
        self.seconds = dict.fromkeys(PARTS, 0.0)
        for module in model.modules():
            if isinstance(module, circuits):
                module.register_forward_pre_hook(self._enter)
                module.register_forward_hook(self._leave)

    def begin(self, watch: bool) -> None:
        """A new step; its parts are measured if `watch`."""
        self.active = watch
        self.seconds = dict.fromkeys(PARTS, 0.0)

    def now(self) -> float:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.perf_counter()

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        if not self.active:
            yield
            return
        start = self.now()
        yield
        self.seconds[name] += self.now() - start

    def _enter(self, *_: object) -> None:
        self._start = self.now() if self.active else 0.0

    def _leave(self, *_: object) -> None:
        if self.active:
            self.seconds["quantum"] += self.now() - self._start


def median_ms(seconds: list[float], skip: int = 50) -> float:
    """Median step in milliseconds after the first `skip`; of all steps where there are no more than that."""
    kept = seconds[skip:] or seconds
    return statistics.median(kept) * 1e3 if kept else float("nan")


def peak_memory_mb(device: torch.device) -> float:
    """Peak memory in MiB: of the device's allocator on CUDA, else the process' resident set (NaN where unknown)."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    if resource is None:
        return float("nan")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)
