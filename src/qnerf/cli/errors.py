"""The one line on standard error for what went wrong, and the exit code that follows from it."""

import argparse
import os
import re
import sys
from collections.abc import Callable
from typing import NoReturn

from qnerf.cli.ends import FAILED, INTERRUPTED, OUTPUT_LOST, WRONG, drop, escape_unencodable
from qnerf.config.plugins import raised_in

MAX_MESSAGE = 2000  # characters; a file can hold a name of a megabyte
OWN_PACKAGES = ("qnerf",)
SHORTAGES = (
    "allocate memory",
    "Too many open files",
    "can't start new thread",
    "failed to map segment",
)
"""What errors say when a limit of the system (`ulimit`, a container's memory) is reached."""


def exit_code(command: Callable[[], int | None]) -> int:
    """Runs a command and returns its exit code.

    A user's mistake (ValueError), an unreadable file (OSError), a missing package, a limit of the system and any error
    in a user's module are one line on standard error. Any other exception is a bug and keeps its traceback.
    """
    escape_unencodable()
    try:
        code = command() or 0
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:
        drop(sys.stdout)
        return OUTPUT_LOST
    except Exception as error:
        if not is_known(error):
            raise
        return report(error)


def is_known(error: BaseException) -> bool:
    """Whether one line is enough for the user to act on; any other error is a bug."""
    missing = isinstance(error, ModuleNotFoundError) and (error.name or "").partition(".")[0] not in OWN_PACKAGES
    return isinstance(error, (ValueError, OSError)) or missing or is_shortage(error) or bool(raised_in(error))


def check_process() -> None:
    """ValueError if the working folder was deleted or NUMBA_NUM_THREADS is not a number.

    Nearly every library asks for the folder, and Numba would print a traceback.
    """
    try:
        os.getcwd()
    except FileNotFoundError:
        raise ValueError("the working folder no longer exists; change to another one") from None
    threads = os.environ.get("NUMBA_NUM_THREADS", "")
    if threads and not re.fullmatch(" *0*[1-9][0-9]{0,8} *", threads):
        raise ValueError(f"NUMBA_NUM_THREADS must be a whole number from 1, got {threads!r:.100}")


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, as those of all other mistakes; `--help` shows the usage."""

    def error(self, message: str) -> NoReturn:
        sys.exit(report(ValueError(message)))


def report(error: Exception, before: str = "") -> int:
    """Prints the error as one line, `before` first; returns the exit code."""
    print(f"{before}error: {one_line(error)}", file=sys.stderr)
    return FAILED if is_shortage(error) or raised_in(error) else WRONG


def is_shortage(error: BaseException) -> bool:
    """Whether the error, or one that led to it, is about too little memory, or too few files or threads."""
    seen: list[BaseException] = []
    current: BaseException | None = error
    while current is not None and current not in seen:
        if isinstance(current, MemoryError) or any(text in str(current) for text in SHORTAGES):
            return True
        seen.append(current)
        current = current.__cause__ or current.__context__
    return False


def one_line(error: BaseException) -> str:
    """The error's message on one line of printable characters, after the place where a plugin raised it."""
    if is_shortage(error):  # nothing more can be imported then
        text = " ".join(str(error).split()) or "not enough memory"
        return f"a limit of this system is reached (see `ulimit -a`): {ascii(text[:300])[1:-1]}"
    from qnerf.records import files, printable  # imports pandas, which `qnerf --help` must not wait for

    if type(error).__name__ == "MissingMandatoryValue":  # OmegaConf's; only commands with Hydra import it
        return f"{getattr(error, 'full_key', '?')} must be given"
    message, _, rest = files.one_line(error).partition(" full_key: ")  # OmegaConf's, too
    key = rest.partition(" ")[0]
    text = f"{key}: {message}" if key else message
    if place := raised_in(error):
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        text = f"{place}: {kind}{text}"
    if len(text) > MAX_MESSAGE:  # what is wrong stands at either end
        half = MAX_MESSAGE // 2
        text = f"{text[: half - 1]}{printable.ELLIPSIS}{text[-half:]}"
    return printable.printable(text)
