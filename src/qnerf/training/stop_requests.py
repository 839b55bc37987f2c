"""Signals that ask a training to stop."""

import contextlib
import signal
from collections.abc import Iterator
from typing import Any


@contextlib.contextmanager
def stop_requests() -> Iterator[list[int]]:
    """Collects SIGINT, SIGTERM and SIGHUP, so that the run can stop with a checkpoint.

    A second SIGINT or SIGTERM acts as usual. SIGHUP may come many times, because a terminal that closes sends it more
    than once; it stays ignored if it is (`nohup`).

    SIGUSR1 and SIGUSR2 are collected, too, if they have a handler: a scheduler's launcher puts the job back into the
    queue with it. That handler is called at the end, when the run has stopped.
    """
    received: list[int] = []
    previous: dict[signal.Signals, Any] = {}
    urgent = (signal.SIGINT, signal.SIGTERM)

    def note(number: int, _frame: object) -> None:
        received.append(number)
        for kind in urgent if number in urgent else [signal.Signals(number)] if number in warnings else []:
            signal.signal(kind, previous[kind])

    hangups = [kind for kind in signal.Signals if kind.name == "SIGHUP"]  # there is none on Windows
    hangups = [kind for kind in hangups if signal.getsignal(kind) is not signal.SIG_IGN]
    warnings = [kind for kind in signal.Signals if kind.name in ("SIGUSR1", "SIGUSR2")]
    warnings = [kind for kind in warnings if callable(signal.getsignal(kind))]
    for kind in (*urgent, *hangups, *warnings):
        with contextlib.suppress(ValueError):  # outside the main thread signals cannot be handled
            previous[kind] = signal.signal(kind, note)
    try:
        yield received
    finally:
        for kind, handler in previous.items():
            signal.signal(kind, handler)
        for kind in warnings:
            if kind in received:
                signal.raise_signal(kind)
