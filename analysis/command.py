"""What the commands of `analysis` share: choosing runs, printing a table, one line for a mistake."""

import argparse
import sys
from collections.abc import Callable, Sequence

import pandas as pd

from qnerf.records.filters import HELP

from .load import runs
from .tables.table import Table

FORMATS: dict[str, Callable[[Table], str]] = {"markdown": Table.markdown, "csv": Table.csv, "latex": Table.latex}


def parser(name: str, description: str, examples: str) -> argparse.ArgumentParser:
    """A parser of `python -m NAME STORE` with the options that choose runs and the format."""
    made = argparse.ArgumentParser(
        prog=f"python -m {name}",
        description=description,
        epilog=f"examples:\n{examples}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument("store", help="folder of runs, or one that analysis.pack made")
    made.add_argument("--filter", metavar="TEXT", help=HELP)
    made.add_argument(
        "--format", choices=FORMATS, default="markdown", help="markdown (default), csv or latex (booktabs)"
    )
    return made


def chosen(options: argparse.Namespace) -> pd.DataFrame:
    """The runs of the store that the filter lets through."""
    return runs(options.store, options.filter)


def show(table: Table, form: str) -> None:
    """Prints the table; the notes of a CSV, which has no place for them, go to standard error."""
    print(FORMATS[form](table))
    if form == "csv":
        print("\n".join(table.notes), file=sys.stderr)


def run(main: Callable[[Sequence[str] | None], None]) -> None:
    """Calls `main`; a mistake or a file that cannot be read or written ends the process with one line."""
    try:
        main(None)
    except (ValueError, OSError) as error:
        sys.exit(f"error: {' '.join(str(error).split())}")
