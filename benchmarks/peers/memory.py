"""Peak memory of one step, from the high-water mark of Linux, which can be reset."""

from collections.abc import Callable
from pathlib import Path


def _kibibytes(key: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(key):
            return int(line.split()[1])
    raise KeyError(key)


def resident(key: str) -> int:
    """Bytes of the process in memory now (VmRSS) or at most so far (VmHWM); -1 where this cannot be measured."""
    try:
        return _kibibytes(key) * 1024
    except (OSError, KeyError):
        return -1


def growth(step: Callable[[], object]) -> int:
    """How many bytes the resident set grows at its peak during `step`; -1 where this cannot be measured."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
        before = _kibibytes("VmRSS")
        step()
        return max(0, _kibibytes("VmHWM") - before) * 1024
    except (OSError, KeyError):
        return -1
