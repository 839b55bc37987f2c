"""What the commands of `analysis` share: choosing runs, printing a table, ending on a mistake."""

import argparse
import sys
from collections.abc import Callable, Sequence

import pandas as pd

from qnerf.cli.errors import Parser, exit_code
from qnerf.cli.text import console
from qnerf.records.filters import HELP
from qnerf.records.printable import printable

from .load import runs
from .tables.table import Table
from .tables.terminal import print_aligned

FORMATS: dict[str, Callable[[Table], str]] = {"markdown": Table.markdown, "csv": Table.csv, "latex": Table.latex}


def parser(name: str, description: str, examples: str = "") -> argparse.ArgumentParser:
    """The parser of a command; `{}` in its examples stands for `qnerf NAME`."""
    program = f"qnerf {name}"
    return Parser(
        prog=program,
        description=description,
        epilog=f"examples:\n{examples.replace('{}', program)}" if examples else None,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def add_runs(parser: argparse.ArgumentParser) -> None:
    """Arguments `store` and `--filter`, which `chosen` reads."""
    parser.add_argument("store", metavar="STORE", help="folder of runs, or of tables that `qnerf pack` made from runs")
    parser.add_argument("--filter", metavar="TEXT", help=HELP)


def add_baseline(parser: argparse.ArgumentParser, what: str) -> None:
    """`--baseline`, for what the help says."""
    parser.add_argument("--baseline", metavar="KEY=VALUE,...", help=what)


def add_format(parser: argparse.ArgumentParser) -> None:
    """`--format`, which `show` takes."""
    parser.add_argument(
        "--format",
        choices=FORMATS,
        help="markdown, csv or latex (booktabs); default: aligned on a terminal, else markdown",
    )


def chosen(options: argparse.Namespace) -> pd.DataFrame:
    """The store's runs that pass the filter."""
    return runs(options.store, options.filter)


def show(table: Table, form: str | None) -> None:
    """Prints the table; a CSV has no room for notes, so its notes go to standard error."""
    out = console()
    if form is None and out.is_terminal:
        print_aligned(table, out)
        return
    print(FORMATS[form or "markdown"](table))
    if form == "csv":
        print("\n".join(map(printable, table.notes)), file=sys.stderr)


def run(main: Callable[[Sequence[str] | None], None]) -> None:
    """Runs a command with the process's arguments and ends the process with its exit code."""
    sys.exit(exit_code(lambda: main(None)))
