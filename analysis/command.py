"""What the commands of `analysis` share: choosing runs, printing a table, ending on a mistake."""

import argparse
import sys
from collections.abc import Callable, Sequence

import pandas as pd

from qnerf.cli.errors import Parser, exit_code
from qnerf.cli.numbers import number
from qnerf.cli.text import console
from qnerf.records.filters import HELP
from qnerf.records.printable import printable

from .load import runs
from .tables.table import Table
from .tables.terminal import print_aligned

COLUMNS = {
    "metrics": "columns with results; the first is the one that is judged",
    "settings": "columns that tell configurations apart",
    "seed": "the column with the seed",
    "scene": "the column with what is learnt, such as a dataset, over which nothing is averaged",
}
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


def add_columns(parser: argparse.ArgumentParser) -> None:
    """What says what the columns are where STORE is a table of another program; `chosen` reads it."""
    group = parser.add_argument_group(
        "runs of other programs",
        "STORE may be a .csv or .parquet file with a row a run (such as an export of W&B), a store of MLflow, or a "
        "database of Trackio. What each column is, is guessed and said; these options say it instead.",
    )
    for name, what in COLUMNS.items():
        several = name in ("metrics", "settings")
        group.add_argument(
            f"--{name}", type=(lambda text: text.split(",")) if several else str, help=what,
            metavar="NAME,..." if several else "NAME",
        )  # fmt: skip


def add_baseline(parser: argparse.ArgumentParser, what: str) -> None:
    """`--baseline`, for what the help says."""
    parser.add_argument("--baseline", metavar="KEY=VALUE,...", help=what)


def add_judged(parser: argparse.ArgumentParser) -> None:
    """`--metric` and `--within`: what verdicts are about."""
    parser.add_argument("--metric", help="what is judged, and ranks the runs; default: psnr where runs have it")
    parser.add_argument(
        "--within",
        type=number(0, 1e9, above=True),
        metavar="DELTA",
        help="smallest difference that matters, in the metric's unit; default: 0.5 dB, for other metrics none",
    )


def add_format(parser: argparse.ArgumentParser) -> None:
    """`--format`, which `show` takes."""
    parser.add_argument(
        "--format",
        choices=FORMATS,
        help="markdown, csv or latex (booktabs); default: aligned on a terminal, else markdown",
    )


def chosen(options: argparse.Namespace) -> pd.DataFrame:
    """The store's runs that pass the filter."""
    return runs(options.store, options.filter, **{name: getattr(options, name, None) for name in COLUMNS})


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
