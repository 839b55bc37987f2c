"""How much memory this process may still ask for, and a one-line refusal before it asks for more."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

LARGE = 2**28  # bytes of work space that are asked for only if the machine has them


def available_bytes() -> int | None:
    """The least that the machine and the container's limit (cgroup) leave; None if nothing tells."""
    return min(_limits(), default=None)


def require(what: str, needed: float, *, hint: str = "") -> None:
    """ValueError "WHAT would take 12 GiB of memory; 8.1 GiB are available" if `needed` bytes are more than there are.

    hint: what to change, appended after a semicolon.
    """
    available = available_bytes()
    if available is not None and needed > available:
        advice = f"; {hint}" if hint else ""
        raise ValueError(f"{what} would take {_text(needed)} of memory; {_text(available)} are available{advice}")


def _text(size: float) -> str:
    return f"{size / 2**30:,.1f} GiB" if size >= 2**30 else f"{size / 2**20:,.0f} MiB"


def _limits() -> Iterator[int]:
    with contextlib.suppress(OSError, StopIteration, ValueError, IndexError):
        lines = Path("/proc/meminfo").read_text().splitlines()
        yield int(next(line for line in lines if line.startswith("MemAvailable:")).split()[1]) * 1024
    with contextlib.suppress(OSError, ValueError):  # "max": no limit
        root = Path("/sys/fs/cgroup")
        yield max(int((root / "memory.max").read_text()) - int((root / "memory.current").read_text()), 0)
