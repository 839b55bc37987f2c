"""Exit codes of commands, and the one line on standard error for a user's mistake."""

import argparse
import errno
import os
import sys
from collections.abc import Callable
from typing import NoReturn

from qnerf.cli.streams import escape_unencodable


def exit_code(command: Callable[[], int | None]) -> int:
    """Runs a command and returns its exit code.

    A user's mistake (ValueError), an unreadable file (OSError) and a missing package are printed as one line on
    standard error, with exit code 2. Any other exception is a bug and keeps its traceback.
    """
    escape_unencodable()
    try:
        code = command() or 0
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        return closed_pipe()
    except (ValueError, OSError) as error:
        return report(error)
    except ImportError as error:
        if lacks_files(error):
            return report(error)
        if not isinstance(error, ModuleNotFoundError) or (error.name or "").partition(".")[0] in ("qnerf", "analysis"):
            raise
        return report(error)


def lacks_files(error: BaseException) -> bool:
    """Whether the process may not open more files: an import then fails in one of many ways."""
    cause: BaseException | None = error
    while cause is not None:
        if getattr(cause, "errno", None) == errno.EMFILE or os.strerror(errno.EMFILE) in str(cause):
            return True
        cause = cause.__cause__ or cause.__context__
    return False


def check_process() -> None:
    """ValueError if the working folder was deleted: nearly every library asks for it."""
    try:
        os.getcwd()
    except FileNotFoundError:
        raise ValueError("the working folder no longer exists; change to another one") from None


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, as those of all other mistakes; `--help` shows the usage."""

    def error(self, message: str) -> NoReturn:
        sys.exit(report(ValueError(message)))


def closed_pipe() -> int:
    """Drops the rest of the output once its reader, such as `head`, has ended; returns the exit code."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 141


def report(error: Exception) -> int:
    """Prints the error as one line; returns the exit code of a user's mistake."""
    print(f"error: {one_line(error)}", file=sys.stderr)
    return 2


def one_line(error: Exception) -> str:
    """The error's message on one line of printable characters."""
    if lacks_files(error):
        return "too many open files; `ulimit -n` shows the limit, expected at least 256"
    from qnerf.records import files, printable  # imports pandas, which `qnerf --help` must not wait for

    if type(error).__name__ == "MissingMandatoryValue":  # OmegaConf's; only commands with Hydra import it
        return f"{getattr(error, 'full_key', '?')} must be given"
    return printable.printable(files.one_line(error).partition(" full_key: ")[0])
