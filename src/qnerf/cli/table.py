"""Tables: they fit the terminal's width, and are aligned plain text with all columns when piped."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from qnerf.cli.text import measured
from qnerf.metrics import Metric
from qnerf.records.printable import printable

GAP = 2

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Column:
    """One column; `cell` makes its text from a row, not yet escaped.

    rank: if the terminal is too narrow, columns of the highest rank are dropped first; rank 0 is never dropped.
    """

    title: str
    cell: Callable[[Row], str]
    rank: int = 0
    right: bool = False
    style: Callable[[Row], str] = lambda row: ""
    limit: int = 40  # characters on a terminal


def metric_column(metric: Metric, title: str | None = None, rank: int = 0, style: str = "") -> Column:
    """The metric of each row, under its label."""
    return Column(
        title or metric.label,
        lambda row: measured(row.get(metric.key), metric),
        rank,
        right=True,
        style=lambda _: style,
    )


def print_table(console: Console, columns: Sequence[Column], rows: Sequence[Row]) -> list[str]:
    """Prints the columns that fit, all of them where nobody reads a terminal; returns their titles."""
    if not console.is_terminal:
        console.file.writelines(f"{line}\n" for line in plain_lines(columns, rows))
        return [column.title for column in columns]
    shown = table(columns, rows, console.width)
    console.print(shown)
    return [str(column.header) for column in shown.columns]


def plain_lines(columns: Sequence[Column], rows: Sequence[Row]) -> Iterator[str]:
    """Lines aligned by spaces, for `awk`: no cell is empty or contains a space, and numbers have no commas."""

    def plain(column: Column, text: str) -> str:
        return printable(text.replace(",", "") if column.right else text).replace(" ", "_") or "-"

    cells = [[plain(column, column.title) for column in columns]]
    cells += [[plain(column, column.cell(row)) for column in columns] for row in rows]
    widths = [max(cell_len(line[i]) for line in cells) for i in range(len(columns))]
    for line in cells:
        padded = []
        for column, text, width in zip(columns, line, widths, strict=True):
            fill = " " * (width - cell_len(text))
            padded.append(fill + text if column.right else text + fill)
        yield (" " * GAP).join(padded).rstrip()


def table(columns: Sequence[Column], rows: Sequence[Row], width: int) -> Table:
    """A table of the columns that fit into `width` characters; what is still too wide ends with an ellipsis."""
    cells = {column: [printable(column.cell(row), column.limit) or "-" for row in rows] for column in columns}
    widths = {column: max(map(cell_len, [column.title, *texts])) for column, texts in cells.items()}
    shown = Table(box=None, padding=(0, GAP, 0, 0), pad_edge=False, header_style="bold")
    kept = fitting(widths, width)
    for column in kept:
        shown.add_column(column.title, justify="right" if column.right else "left", no_wrap=True, overflow="ellipsis")
    for number, row in enumerate(rows):
        shown.add_row(*(Text(cells[column][number], column.style(row)) for column in kept))
    return shown


def fitting(widths: Mapping[Column, int], width: int) -> list[Column]:
    """The columns that stay where those of the highest rank are dropped until the others fit."""
    kept = dict(widths)
    while sum(kept.values()) + GAP * (len(kept) - 1) > width:
        last = max(kept, key=lambda column: column.rank)
        if last.rank == 0:
            break
        del kept[last]
    return list(kept)
