"""How a command ends: by signals, and when nobody reads its output any more.

`interruptible` goes around every command: Ctrl-C, SIGTERM and SIGHUP end it alike. `stoppable` goes around one that
trains. There, a standard stream whose reader is gone (`| head`, a closed terminal) raises nothing; later output is
dropped, and `output_lost` says so.
"""

import contextlib
import os
import select
import signal
import sys
from collections.abc import Iterator
from typing import Any

INTERRUPTED, OUTPUT_LOST = 130, 141  # exit codes


class Output:
    """Standard output or standard error. After the first failed write, the rest is dropped."""

    def __init__(self, stream: Any, watched: bool) -> None:
        self.stream = stream
        self.lost = False
        self._poll: Any = None
        with contextlib.suppress(OSError, ValueError, AttributeError):  # not a real file, or no poll on this system
            if watched:
                poll = select.poll()
                poll.register(stream.fileno(), 0)  # errors and hang-ups are always reported
                self._poll = poll

    def write(self, text: str) -> int:
        if not self.lost:
            try:
                self.stream.write(text)
            except OSError:
                self._drop()
        return len(text)

    def flush(self) -> None:
        if not self.lost:
            try:
                self.stream.flush()
            except OSError:
                self._drop()

    def is_lost(self) -> bool:
        """Whether a write has failed or would fail, because the reader of a pipe or the terminal is gone."""
        if not self.lost and self._poll is not None:
            gone = select.POLLERR | select.POLLHUP
            if any(event & gone for _, event in self._poll.poll(0)):
                self._drop()
        return self.lost

    def _drop(self) -> None:
        self.lost = True
        with contextlib.suppress(OSError, ValueError, AttributeError):  # what is buffered must not fail at exit
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self.stream.fileno())
            os.close(null)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


_outputs: list[Output] = []


def output_lost() -> bool:
    """Whether nobody reads standard output or standard error any more."""
    return any(output.is_lost() for output in _outputs)


def stopped_code() -> int:
    """The exit code of a command that was stopped."""
    return OUTPUT_LOST if output_lost() else INTERRUPTED


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """SIGTERM and SIGHUP raise KeyboardInterrupt, so that a command removes what it has half written.

    A signal that is ignored stays ignored: with `nohup`, a command outlives its terminal.
    """
    previous: dict[int, Any] = {}
    for name in ("SIGTERM", "SIGHUP"):
        kind = getattr(signal, name, None)
        with contextlib.suppress(ValueError):  # outside the main thread signals cannot be handled
            if kind is not None and signal.getsignal(kind) is signal.SIG_DFL:
                previous[kind] = signal.signal(kind, signal.default_int_handler)
    try:
        yield
    finally:
        for kind, handler in previous.items():
            signal.signal(kind, handler)


@contextlib.contextmanager
def stoppable() -> Iterator[None]:
    """As `interruptible`, and lost output raises nothing."""
    if _outputs:  # a command inside another one
        yield
        return
    open_standard_streams()
    outlives = hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    streams = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (Output(stream, not (outlives and stream.isatty())) for stream in streams)
    _outputs[:] = sys.stdout, sys.stderr
    try:
        with interruptible():
            yield
    finally:
        for output in _outputs:
            output.flush()
        _outputs.clear()
        sys.stdout, sys.stderr = streams


def open_standard_streams() -> None:
    """Opens those that the command was started without (`>&-`).

    Otherwise the next file that is opened would get the number of standard output, and printed text would go into it.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            handle = os.open(os.devnull, os.O_RDWR)
            if handle != number:
                os.dup2(handle, number)
                os.close(handle)
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "r" if number == 0 else "w", closefd=False))  # noqa: SIM115
