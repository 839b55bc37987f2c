"""Tables: they fit the terminal's width, and are aligned plain text with all columns when piped."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich.cells import cell_len, set_cell_size
from rich.console import Console
from rich.table import Table
from rich.text import Text

from qnerf.cli.text import measured
from qnerf.metrics import Metric
from qnerf.records.printable import ELLIPSIS, printable

GAP = 2

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Column:
    """One column; `cell` makes its text from a row, not yet escaped.

    rank: if the terminal is too narrow, columns of the highest rank are dropped first; rank 0 is never dropped.
    min_width: the column shrinks to this width before others are dropped; the last `tail` characters of its text stay.
    """

    title: str
    cell: Callable[[Row], str]
    rank: int = 0
    right: bool = False
    style: Callable[[Row], str] = lambda row: ""
    min_width: int | None = None
    tail: int = 0
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


def print_table(console: Console, columns: Sequence[Column], rows: Sequence[Row]) -> None:
    if console.is_terminal:
        console.print(table(columns, rows, console.width))
    else:
        console.file.writelines(f"{line}\n" for line in plain_lines(columns, rows))


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
    """A table of at most `width` characters."""
    cells = _cells(columns, rows)
    shown = Table(box=None, padding=(0, GAP, 0, 0), pad_edge=False, header_style="bold")
    fitted = _fit(columns, cells, width)
    for column in fitted:
        shown.add_column(column.title, justify="right" if column.right else "left", no_wrap=True, overflow="ellipsis")
    for number, row in enumerate(rows):
        texts = [shorten(cells[column.title][number], room, column.tail) for column, room in fitted.items()]
        shown.add_row(*(Text(text, column.style(row)) for column, text in zip(fitted, texts, strict=True)))
    return shown


def fitting(columns: Sequence[Column], rows: Sequence[Row], width: int) -> list[Column]:
    """The columns that `table` shows."""
    return list(_fit(columns, _cells(columns, rows), width))


def _cells(columns: Sequence[Column], rows: Sequence[Row]) -> dict[str, list[str]]:
    return {c.title: [printable(c.cell(row), c.limit) or "-" for row in rows] for c in columns}


def _fit(columns: Sequence[Column], cells: Mapping[str, Sequence[str]], width: int) -> dict[Column, int]:
    """The columns that fit, with their widths; columns that shrink take the room that is left."""
    full = {column: max(map(cell_len, [column.title, *cells[column.title]])) for column in columns}
    fitted = {column: min(full[column], column.min_width or full[column]) for column in columns}
    while (room := width - sum(fitted.values()) - GAP * (len(fitted) - 1)) < 0:
        last = max(fitted, key=lambda column: column.rank)
        if last.rank == 0:
            break
        del fitted[last]
    for column, smallest in fitted.items():
        grow = min(max(room, 0), full[column] - smallest)
        fitted[column] += grow
        room -= grow
    return fitted


def shorten(text: str, width: int, tail: int = 0) -> str:
    """`text` cut to `width` characters; its last `tail` stay, such as `s0-397bfb074c` of a run's id.

    >>> shorten("poster-qcolor-s0-397bfb074c", 20, tail=13)
    'poster…s0-397bfb074c'
    """
    if cell_len(text) <= width:
        return text
    tail = min(tail, width - 1)
    return set_cell_size(text, width - 1 - tail) + ELLIPSIS + text[len(text) - tail :]
