"""How long work is going to take: a training from the cost model of circuits and then from a step, other work from a
part of it."""

import math
import time
from collections.abc import Callable

from torch import nn

from qnerf.kernels.jit import loop_threads
from qnerf.quantum import QuantumLayer

FASTEST = 1e10  # multiply-adds of a circuit in a second of one thread: 1e9 to 2e10; so advice allows ten times the time
FORWARD = 0.4  # of a step's time, its forward pass, which is all that a ray of an evaluation takes
WORTH_A_LINE = 600.0  # seconds of a training, from which on its time is said
TELL = 60.0  # seconds of other work, from which on its time is said
FEW, LONG_ENOUGH = 16, 1.0  # items, and seconds of a part of the work, from which the whole is reckoned


def seconds_of_circuits(model: nn.Module, points: int) -> float:
    """About how long the circuits of a model take at best in a step that evaluates them at `points` points."""
    costs = [module.cost(points) for module in model.modules() if isinstance(module, QuantumLayer)]
    operations = sum(cost.operations * points + cost.operations_once for cost in costs)
    return operations / (FASTEST * loop_threads())


def foretold(basis: str, step: float, whole: float, hours: float) -> str | None:
    """A line with the seconds of a step and of the whole, after `basis`; None where the whole is short.

    Raises:
        ValueError: the whole takes more than `hours`, which is `run.hours`.
    """
    told = f"{basis}a step takes about {step:,.2f} s, the whole {whole / 3600:,.1f} hours"
    if whole > 3600 * hours:
        raise ValueError(f"{told}, more than run.hours={hours:g}; run.hours={math.ceil(whole / 360)} goes on")
    return told if whole > WORTH_A_LINE else None


def seconds_each(work: Callable[[int], object], most: int) -> float:
    """Seconds for one of `most` items: `work(count)` is timed for more and more of them until it takes a second."""
    count = min(FEW, most)
    work(count)  # compiles
    while True:
        begun = time.perf_counter()
        work(count)
        seconds = time.perf_counter() - begun
        if seconds > LONG_ENOUGH or count == most:
            return seconds / count
        count = min(8 * count, most)


def announced(what: str, seconds: float, hours: float, less: str, option: str = "run.hours={}") -> str | None:
    """A line with the time of work that is not a training; None where it is short.

    less: what makes it shorter. option: what says that it may take so many hours.

    Raises:
        ValueError: it takes more than `hours`.
    """
    told = f"{what}: about {seconds / 60:,.0f} minutes; {less}"
    if seconds > 3600 * hours:
        raise ValueError(f"{told}, or {option.format(math.ceil(seconds / 1800))} goes on")
    return told if seconds > TELL else None
