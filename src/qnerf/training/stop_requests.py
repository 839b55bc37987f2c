"""Signals that ask a training to stop."""

import _thread
import contextlib
import signal
import socket
from collections.abc import Callable, Collection, Iterator
from threading import Event, Thread
from typing import Any


def interrupt(message: str) -> None:
    """Raises KeyboardInterrupt in the main thread, once no loop keeps it."""
    _thread.interrupt_main()


end: Callable[[str], None] = interrupt
"""How the thread stops this process. A command ends it at once, with a message."""
URGENT = (signal.SIGINT, signal.SIGTERM)
GRACE = 8.0  # seconds after a request, within which the run is to stop by itself


@contextlib.contextmanager
def stop_requests(last_words: Callable[[], str | None] = lambda: None) -> Iterator[list[int]]:
    """Collects SIGINT, SIGTERM and SIGHUP, so that the run can stop with a checkpoint.

    A compiled loop may take minutes, and Python handles no signal before it returns; but it releases the GIL. So a
    thread hears of the signal, too. After `GRACE` seconds it stops the process (`end`), as soon as `last_words` returns
    what there is to say: that nothing is lost.

    A second SIGINT or SIGTERM acts as usual. SIGHUP may come many times, because a terminal that closes sends it more
    than once; it stays ignored if it is (`nohup`).

    SIGUSR1 and SIGUSR2 are collected, too, if they have a handler: a scheduler's launcher puts the job back into the
    queue with it. That handler is called at the end, when the run has stopped.
    """
    received: list[int] = []
    previous: dict[signal.Signals, Any] = {}

    def note(number: int, _frame: object) -> None:
        received.append(number)
        for kind in URGENT if number in URGENT else [signal.Signals(number)] if number in warnings else []:
            signal.signal(kind, previous[kind])

    hangups = [kind for kind in signal.Signals if kind.name == "SIGHUP"]  # there is none on Windows
    hangups = [kind for kind in hangups if signal.getsignal(kind) is not signal.SIG_IGN]
    warnings = [kind for kind in signal.Signals if kind.name in ("SIGUSR1", "SIGUSR2")]
    warnings = [kind for kind in warnings if callable(signal.getsignal(kind))]
    for kind in (*URGENT, *hangups, *warnings):
        with contextlib.suppress(ValueError):  # outside the main thread signals cannot be handled
            previous[kind] = signal.signal(kind, note)
    try:
        with heard(URGENT, last_words):
            yield received
    finally:
        for kind, handler in previous.items():
            signal.signal(kind, handler)
        for kind in warnings:
            if kind in received:
                signal.raise_signal(kind)


@contextlib.contextmanager
def heard(urgent: Collection[int], last_words: Callable[[], str | None]) -> Iterator[None]:
    """Stops the process after an urgent signal, see `stop_requests`, if the body has not ended by then."""
    here, there = socket.socketpair()
    there.setblocking(False)
    ended = Event()

    def listen() -> None:
        while not {*here.recv(64)} & {*urgent, 0}:
            pass
        ended.wait(GRACE)
        while not ended.wait(0.2):
            if (message := last_words()) is not None:
                end(message)

    try:
        before = signal.set_wakeup_fd(there.fileno(), warn_on_full_buffer=False)
    except ValueError:  # outside the main thread
        before = None
    listener = Thread(target=listen, name="qnerf-signals", daemon=True)
    listener.start()
    try:
        yield
    finally:
        ended.set()
        if before is not None:
            signal.set_wakeup_fd(before)
        there.send(b"\0")
        listener.join()
        here.close()
        there.close()
