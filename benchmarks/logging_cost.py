"""What logging a row of metrics costs a training step, with our writer and with TensorBoard's.

`paced` waits between the calls like a training and measures the processor time of the whole process, including threads.
`flat_out` logs as fast as it can, until the rows are on disk.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Protocol

from qnerf.records import RunStore

KEYS = tuple(f"train/value_{number}" for number in range(10))


class Logger(Protocol):
    def log(self, step: int) -> None: ...

    def close(self) -> None: ...


class Ours:
    """Flushes and heartbeats every 3 s, as in a training."""

    def __init__(self, folder: Path) -> None:
        run = RunStore(folder).claim("a", {"seed": 0}).run
        assert run is not None
        self._run = run

    def log(self, step: int) -> None:
        self._run.log(step, 0.02 * step, dict.fromkeys(KEYS, 1.0 / (step + 1)))

    def close(self) -> None:
        self._run.finish()


class TensorBoard:
    """Flushes when its queue is full, and every two minutes."""

    def __init__(self, folder: Path) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._writer = SummaryWriter(str(folder))

    def log(self, step: int) -> None:
        for key in KEYS:
            self._writer.add_scalar(key, 1.0 / (step + 1), step)

    def close(self) -> None:
        self._writer.close()


class Nothing:
    """The cost of the measurement itself."""

    def __init__(self, folder: Path) -> None: ...

    def log(self, step: int) -> None: ...

    def close(self) -> None: ...


LOGGERS: dict[str, Callable[[Path], Logger]] = {"qnerf": Ours, "TensorBoard": TensorBoard}


def paced(name: str, steps: int, step_s: float) -> dict[str, float]:
    """us_per_call: median. share: processor time of logging / duration of the steps, until the run is closed."""
    with tempfile.TemporaryDirectory() as folder:
        _, idle = _paced(Nothing(Path(folder)), steps, step_s)
        calls, used = _paced(LOGGERS[name](Path(folder) / "runs"), steps, step_s)
    return {"us_per_call": 1e6 * median(calls), "share": (used - idle) / (steps * step_s)}


def _paced(logger: Logger, steps: int, step_s: float) -> tuple[list[float], float]:
    calls = []
    start = time.process_time()
    for step in range(steps):
        time.sleep(step_s)
        before = time.perf_counter()
        logger.log(step)
        calls.append(time.perf_counter() - before)
    logger.close()
    return calls, time.process_time() - start


def flat_out(name: str, steps: int) -> float:
    """Values a second, from the first call until all are on disk and the writer is closed."""
    with tempfile.TemporaryDirectory() as folder:
        logger = LOGGERS[name](Path(folder) / "runs")
        start = time.perf_counter()
        for step in range(steps):
            logger.log(step)
        logger.close()
        return steps * len(KEYS) / (time.perf_counter() - start)
