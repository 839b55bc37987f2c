"""The console command `qnerf`. `qnerf run` takes the same options as `python -m src.run`."""

import argparse
import importlib
import os
import sys

# Before PyTorch starts its threads: waiting threads sleep instead of spinning. A step is many small operations, and two
# spinning threads on a busy two-core machine slow it down more than tenfold.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from qnerf.cli.commands import COMMANDS
from qnerf.cli.errors import one_line


def usage() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {what}" for name, what in {"run": "train and evaluate", **COMMANDS}.items()]
    return "\n".join(["usage: qnerf COMMAND ...", "", *lines, "", "`qnerf COMMAND --help` says what each one takes"])


def main() -> None:
    """The console command `qnerf`."""
    command, *rest = sys.argv[1:] or ["--help"]
    if command in ("-h", "--help"):
        print(usage())
    elif command == "run":
        sys.argv = ["qnerf run", *rest]
        run()
    elif command in COMMANDS:
        sys.exit(dispatch(command, rest))
    else:
        sys.exit(report(ValueError(f"unknown command {command!r}; known: run, {', '.join(COMMANDS)}")))


def run() -> None:
    """`qnerf run` and `python -m src.run`: Hydra reads sys.argv."""
    from qnerf.cli.launch import run_command

    run_command()


def dispatch(command: str, arguments: list[str]) -> int:
    """Runs one of `COMMANDS`; its exit code. What the user got wrong is one line on stderr, and exit code 2."""
    module = importlib.import_module(f"qnerf.cli.commands.{command}")
    parser = argparse.ArgumentParser(prog=f"qnerf {command}")
    module.arguments(parser)
    try:
        code = module.main(parser.parse_intermixed_args(arguments)) or 0
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # `| head` has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except (ValueError, OSError) as error:
        return report(error)


def report(error: Exception) -> int:
    print(f"error: {one_line(error)}", file=sys.stderr)
    return 2
