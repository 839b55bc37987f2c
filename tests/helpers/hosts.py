"""Makes a process one of another machine: a host name, a boot and a clock of its own, and a short heartbeat."""

import platform
import time

from qnerf.cli import sweep
from qnerf.records import RunStore, owner


def other_machine(name: str, ahead: float = 0.0) -> None:
    """ahead: by how many seconds its clock is."""
    clock = time.time
    platform.node = lambda: name
    owner._boot_id = lambda: name  # type: ignore[assignment]
    time.time = lambda: clock() + ahead  # type: ignore[assignment]
    owner.HEARTBEAT_LIMIT, sweep.RETRY = 6.0, 0.2
    RunStore.__init__.__kwdefaults__.update(every=0.2, watch=0.5)
