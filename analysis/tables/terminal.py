"""A table on a terminal: aligned, with the metrics that fit beside each other."""

from collections.abc import Callable

from rich.console import Console
from rich.text import Text

from qnerf.cli.table import Column, Row, print_table
from qnerf.metrics import METRICS
from qnerf.records.printable import printable

from .table import Table


def print_aligned(table: Table, console: Console) -> None:
    """Prints the table and its notes.

    Metrics after the first are left out, the last ones first, until the rest fits: keys, the first metric, difference
    and seeds stay. A line under the table names what was left out.
    """
    titles = list(map(str, table.text.columns))
    headings = {metric.heading for metric in METRICS.values()}
    metrics = [title for title in titles if title in headings][1:]
    ranks = {title: rank for rank, title in enumerate(metrics, 1)}
    columns = [_column(table, title, ranks.get(title, 0)) for title in titles]
    rows = [{"number": number} for number in range(len(table.text))]
    shown = print_table(console, columns, rows)
    left = [title for title in titles if title not in shown]
    notes = [*table.notes, f"left out, because the terminal is narrow: {', '.join(left)}"] if left else table.notes
    for note in notes:
        console.print(Text(printable(note)))


def _column(table: Table, title: str, rank: int) -> Column:
    cells, bold = table.text[title], table.bold[title]
    numeric = bool(cells.str.match(r"[-+\d]").any())
    style: Callable[[Row], str] = lambda row: "bold" if bold.iloc[row["number"]] else ""  # noqa: E731
    return Column(title, lambda row: str(cells.iloc[row["number"]]), rank, right=numeric, style=style)
