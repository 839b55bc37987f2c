"""Tables: they fit the terminal's width, and are aligned plain text with all columns when piped."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich.cells import cell_len, set_cell_size
from rich.console import Console
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
        for line in table(columns, rows, console.width):
            console.print(line, no_wrap=True, overflow="ellipsis", crop=True)
        return
    console.file.writelines(f"{line}\n" for line in plain_lines(columns, rows))


def plain_lines(columns: Sequence[Column], rows: Sequence[Row]) -> Iterator[str]:
    """Lines aligned by spaces, for `awk`: no cell is empty or contains a space, and numbers have no commas."""
    cells = [[_plain(column, column.title) for column in columns]]
    cells += [[_plain(column, column.cell(row)) for column in columns] for row in rows]
    widths = [max(cell_len(line[i]) for line in cells) for i in range(len(columns))]
    for line in cells:
        yield _align(columns, line, widths).rstrip()


def _plain(column: Column, text: str) -> str:
    return printable(text.replace(",", "") if column.right else text).replace(" ", "_") or "-"


def table(columns: Sequence[Column], rows: Sequence[Row], width: int) -> list[Text]:
    """Lines of at most `width` characters, the titles first."""
    cells = _cells(columns, rows)
    columns, widths = fit(columns, _widths(cells), width)
    lines = [Text((" " * GAP).join(_padded(c, c.title, widths[c.title]) for c in columns).rstrip(), "bold")]
    for number, row in enumerate(rows):
        line = Text()
        for column in columns:
            text = _padded(
                column, shorten(cells[column.title][number], widths[column.title], column.tail), widths[column.title]
            )
            line.append(text, column.style(row))
            line.append(" " * GAP)
        line.rstrip()
        lines.append(line)
    return lines


def fitting(columns: Sequence[Column], rows: Sequence[Row], width: int) -> list[Column]:
    """The columns that `table` shows."""
    return fit(columns, _widths(_cells(columns, rows)), width)[0]


def _cells(columns: Sequence[Column], rows: Sequence[Row]) -> dict[str, list[str]]:
    return {c.title: [printable(c.cell(row), c.limit) or "-" for row in rows] for c in columns}


def _widths(cells: Mapping[str, Sequence[str]]) -> dict[str, int]:
    return {title: max(map(cell_len, [title, *own])) for title, own in cells.items()}


def fit(columns: Sequence[Column], widths: Mapping[str, int], width: int) -> tuple[list[Column], dict[str, int]]:
    """The columns that fit, and their widths; shrinkable columns take the room that is left."""
    columns = list(columns)
    while True:
        fitted = {c.title: min(widths[c.title], c.min_width or widths[c.title]) for c in columns}
        room = width - sum(fitted.values()) - GAP * (len(columns) - 1)
        last = max(columns, key=lambda c: c.rank)
        if room >= 0 or last.rank == 0:
            break
        columns.remove(last)
    for title, smallest in fitted.items():
        grow = min(max(room, 0), widths[title] - smallest)
        fitted[title] += grow
        room -= grow
    return columns, fitted


def shorten(text: str, width: int, tail: int = 0) -> str:
    """`text` cut to `width` characters; its last `tail` stay, such as `s0-397bfb074c` of a run's id.

    >>> shorten("poster-qcolor-s0-397bfb074c", 20, tail=13)
    'poster…s0-397bfb074c'
    """
    if cell_len(text) <= width:
        return text
    tail = min(tail, width - 1)
    return set_cell_size(text, width - 1 - tail) + ELLIPSIS + text[len(text) - tail :]


def _align(columns: Sequence[Column], line: Sequence[str], widths: Sequence[int]) -> str:
    return (" " * GAP).join(_padded(c, text, w) for c, text, w in zip(columns, line, widths, strict=True))


def _padded(column: Column, text: str, width: int) -> str:
    fill = " " * max(width - cell_len(text), 0)
    return fill + text if column.right else text + fill
