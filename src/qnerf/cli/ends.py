"""How a command ends: exit codes, signals, and output that nobody reads any more.

| code | |
|---|---|
| 0 | done |
| 1 | the command was understood; something failed, differed or was refused while it ran |
| 2 | the command was wrong, or something that it needs is missing; nothing was begun |
| 130 | stopped by Ctrl-C, SIGTERM or SIGHUP |
| 141 | stopped because nobody reads the output any more, such as `head` |

`interruptible` goes around every command: Ctrl-C, SIGTERM and SIGHUP end it alike. `stoppable` goes around one that
trains. There, output that cannot be written raises nothing: it is dropped, and `output_lost` says so.
"""

import contextlib
import os
import signal
import sys
from collections.abc import Iterator
from typing import Any

from qnerf.training import stop_requests

DONE, FAILED, WRONG, INTERRUPTED, OUTPUT_LOST = 0, 1, 2, 130, 141


class Output:
    """Standard output or standard error. After the first failed write, the rest is dropped."""

    def __init__(self, stream: Any) -> None:
        self.stream = stream
        self.lost = False

    def write(self, text: str) -> int:
        self._try(self.stream.write, text)
        return len(text)

    def flush(self) -> None:
        self._try(self.stream.flush)

    def _try(self, action: Any, *arguments: str) -> None:
        if self.lost:
            return
        try:
            action(*arguments)
        except OSError:
            self.lost = True
            drop(self.stream)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


_outputs: list[Output] = []


def drop(stream: Any) -> None:
    """Sends what the stream has buffered, and all that follows, to the null device."""
    with contextlib.suppress(OSError, ValueError, AttributeError):  # not a real file
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)


def escape_unencodable() -> None:
    """Characters that the encoding of the output lacks, such as an umlaut in ASCII, are printed as escapes."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def output_lost() -> bool:
    """Whether output of this command could not be written."""
    return any(output.lost for output in _outputs)


def stopped_code() -> int:
    """The exit code of a command that was stopped."""
    return OUTPUT_LOST if output_lost() else INTERRUPTED


def end(message: str) -> None:
    """Ends a command that was stopped at once, whatever its threads do."""
    print(message, file=sys.stderr, flush=True)
    os._exit(stopped_code())


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
    outer, stop_requests.end = stop_requests.end, end
    try:
        yield
    finally:
        stop_requests.end = outer
        for kind, handler in previous.items():
            signal.signal(kind, handler)


@contextlib.contextmanager
def stoppable() -> Iterator[None]:
    """As `interruptible`, and lost output raises nothing."""
    if _outputs:  # a command inside another one
        yield
        return
    streams = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (stream and Output(stream) for stream in streams)
    _outputs[:] = filter(None, (sys.stdout, sys.stderr))  # type: ignore[arg-type]
    try:
        with interruptible():
            yield
    finally:
        for output in _outputs:
            output.flush()
        _outputs.clear()
        sys.stdout, sys.stderr = streams
