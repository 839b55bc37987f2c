"""The console command `qnerf`. `qnerf run` takes the same options as `python -m src.run`."""

import importlib
import os
import sys
from difflib import get_close_matches
from importlib.metadata import version

# Before PyTorch starts its threads: waiting threads sleep instead of spinning. A step is many small operations, and
# spinning threads slow a busy two-core machine down more than tenfold.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from qnerf.cli.commands import ANALYSIS, COMMANDS, GROUPS
from qnerf.cli.ends import OUTPUT_LOST, escape_unencodable, interruptible, output_lost, stoppable, stopped_code
from qnerf.cli.errors import Parser, exit_code, report
from qnerf.training.stop_requests import URGENT, heard

FIRST_STEPS = """\
first steps:
  qnerf run                       train on the built-in scene; the run goes to runs/<id>
  qnerf runs                      list the runs
  qnerf report runs               write a page about them, report/index.html
  qnerf run -m field=classical,qcolor seed=0,1,2
                                  train a sweep: every combination is a run

`qnerf COMMAND --help` lists the options of a command."""


def usage() -> str:
    """The text of `qnerf --help`: the commands in groups, one line each."""
    width = max(map(len, COMMANDS))
    lines = ["usage: qnerf COMMAND ...", "", "Quantum-classical neural radiance fields.", ""]
    for title, commands in GROUPS.items():
        lines += [f"{title}:", *(f"  {name:<{width}}  {purpose}" for name, purpose in commands.items()), ""]
    return "\n".join([*lines, FIRST_STEPS])


def main() -> None:
    """The console command `qnerf`."""
    escape_unencodable()
    command, *arguments = sys.argv[1:] or ["--help"]
    if command in ("-h", "--help", "help"):
        sys.exit(exit_code(lambda: print(usage())))
    elif command == "--version":
        sys.exit(exit_code(lambda: print(f"qnerf {version('qnerf')}")))
    elif command == "run":
        sys.argv = ["qnerf run", *arguments]
        run()
    elif command in COMMANDS:
        sys.exit(dispatch(command, arguments))
    else:
        near = ["run"] if command == "train" else get_close_matches(command, COMMANDS, n=1)
        hint = f"did you mean {near[0]}? " if near else "did you mean qnerf run? " if "=" in command else ""
        sys.exit(report(ValueError(f"unknown command {command!r}; {hint}known: {', '.join(COMMANDS)}")))


def run() -> None:
    """`qnerf run` and `python -m src.run`: Hydra reads sys.argv."""
    escape_unencodable()
    with stoppable(), heard(URGENT, lambda: "stopped"):  # a library may have swallowed the KeyboardInterrupt
        try:
            from qnerf.cli.launch import run_command

            run_command()
            if output_lost():
                sys.exit(OUTPUT_LOST)
        except KeyboardInterrupt:  # while modules are imported
            print("stopped", file=sys.stderr)
            sys.exit(stopped_code())


def dispatch(command: str, arguments: list[str]) -> int:
    """Runs one of `COMMANDS` other than `run`; returns its exit code."""

    def start() -> int | None:
        code: int | None
        if command in ANALYSIS:
            code = importlib.import_module(f"qnerf.analysis.{ANALYSIS[command]}").main(arguments)
        else:
            module = importlib.import_module(f"qnerf.cli.commands.{command}")
            parser = Parser(prog=f"qnerf {command}")
            module.arguments(parser)
            code = module.main(parser.parse_intermixed_args(arguments))
        return code

    with interruptible(), heard(URGENT, lambda: "stopped"):
        return exit_code(start)
