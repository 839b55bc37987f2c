"""Makes a process one of another machine: a host name, a boot and a clock of its own, and a short heartbeat."""

import platform
import time

from qnerf.cli import sweep
from qnerf.records import RunStore, owner
from qnerf.training.trainer import Trainer


def other_machine(name: str, ahead: float = 0.0, hangs_at: int = 0) -> None:
    """ahead: by how many seconds its clock is. hangs_at: the step that it never ends; 0: none."""
    clock = time.time
    platform.node = lambda: name
    owner._boot_id = lambda: name  # type: ignore[assignment]
    time.time = lambda: clock() + ahead  # type: ignore[assignment]
    owner.HEARTBEAT_LIMIT, sweep.RETRY = 6.0, 0.2
    RunStore.__init__.__kwdefaults__.update(every=0.2)
    take_step = Trainer.take_step

    def step(self: Trainer, measure: bool) -> dict[str, float]:
        while self.step + 1 == hangs_at:
            time.sleep(0.1)
        return take_step(self, measure)

    Trainer.take_step = step  # type: ignore[method-assign]
