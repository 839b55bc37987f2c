"""The one line on standard error for what went wrong, and the exit code that follows from it."""

import argparse
import errno
import sys
from collections.abc import Callable
from typing import NoReturn

from qnerf.cli.ends import FAILED, INTERRUPTED, OUTPUT_LOST, WRONG, drop, escape_unencodable
from qnerf.config.plugins import raised_in

MAX_MESSAGE = 2000  # characters; a file can hold a name of a megabyte
OWN_PACKAGES = ("qnerf",)
EXTRAS = {"optuna": "search", "uvicorn": "serve", "starlette": "serve", "viser": "view"}
"""Module -> the extra that installs it."""


def exit_code(command: Callable[[], int | None]) -> int:
    """Runs a command and returns its exit code.

    A user's mistake (ValueError), an unreadable file (OSError), a missing package, too little memory and any error in
    a user's module are one line on standard error. Any other exception is a bug and keeps its traceback.
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


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, as all mistakes are; `--help` shows the usage."""

    def error(self, message: str) -> NoReturn:
        sys.exit(report(ValueError(message)))


def report(error: Exception) -> int:
    """Prints the error as one line; returns the exit code."""
    print(f"error: {one_line(error)}", file=sys.stderr)
    return FAILED if is_shortage(error) or is_full(error) or raised_in(error) else WRONG


def is_shortage(error: BaseException) -> bool:
    """Whether there is too little memory; PyTorch says so by a RuntimeError, of a GPU in other words."""
    said = isinstance(error, RuntimeError) and "out of memory" in str(error)
    return isinstance(error, MemoryError) or said or "allocate memory" in str(error)


def is_full(error: BaseException) -> bool:
    """Whether the disk is full, or the user's part of it."""
    cause = error if isinstance(error, OSError) else error.__cause__
    return isinstance(cause, OSError) and cause.errno in (errno.ENOSPC, errno.EDQUOT)


def one_line(error: BaseException) -> str:
    """The error's message on one line of printable characters, after the place where a plugin raised it."""
    if is_shortage(error):  # nothing more can be imported then
        return f"not enough memory: {ascii(' '.join(str(error).split())[:300])[1:-1]}"
    if isinstance(error, ModuleNotFoundError) and error.name in EXTRAS:
        return f'{error.name} is not installed: pip install "qnerf[{EXTRAS[error.name]}]"'
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
