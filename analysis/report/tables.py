"""Tables of the page and their copies as text; a table that cannot be made is a line that says why."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pandas as pd

from ..figures import points
from ..figures.files import collecting
from ..selection import select
from ..settings import LABELS, configuration
from ..tables import Table, ablation, smallest

MAX_ERROR = 600  # characters of an error that may list every column
MAX_ROWS = 30  # configurations of a scene in the ablation table
FIRST_KEYS = ("scene_name", "field", "density", "color")


@dataclass(frozen=True)
class Cell:
    text: str
    number: bool
    best: bool = False


@dataclass(frozen=True)
class ShownTable:
    """A table of text, its notes and its copies (name, text); or why it is `absent`."""

    title: str
    heads: tuple[Cell, ...] = ()
    rows: tuple[tuple[Cell, ...], ...] = ()
    notes: tuple[str, ...] = ()
    copies: tuple[tuple[str, str], ...] = ()
    absent: str = ""


def shown(title: str, table: Table) -> ShownTable:
    numbers = [bool(column.str.fullmatch(r"[-+\d.,\s±()n=\[\]*]*").all()) for _, column in table.text.items()]
    heads = tuple(Cell(str(name), number) for name, number in zip(table.text.columns, numbers, strict=True))
    rows = tuple(
        tuple(Cell(*cell) for cell in zip(texts, numbers, bolds, strict=True))
        for texts, bolds in zip(table.text.to_numpy(), table.bold.to_numpy(), strict=True)
    )
    copies = (("LaTeX", table.latex()), ("Markdown", table.markdown()), ("CSV", table.csv()))
    return ShownTable(title, heads, rows, table.notes, copies)


def attempt(title: str, make: Callable[..., Table], *arguments: Any) -> ShownTable:
    """The table under this title, or why there is none."""
    errors: dict[str, str] = {}
    with collecting(errors, title):
        return shown(title, make(*arguments))
    return ShownTable(title, absent=f"{errors[title][:MAX_ERROR]}.")


def row_keys(runs: pd.DataFrame) -> list[str]:
    """Scene, field, heads, and further settings that are needed so that no row mixes configurations."""
    keys = list(FIRST_KEYS)
    settings = ("encoder", "hash", *LABELS, *configuration(runs))
    for name in (name for name in settings if runs[name].nunique(dropna=False) > 1):
        if name not in keys and runs.groupby(keys, dropna=False)[name].nunique(dropna=False).max() > 1:
            keys.append(name)
    return keys


def over_seeds(frame: pd.DataFrame) -> Table:
    """`ablation` of the best `MAX_ROWS` configurations of each scene, against the classical one if there is one."""
    runs = select(frame).runs
    best, not_shown = points.best(runs, ["psnr"], MAX_ROWS)
    runs = runs.loc[[row for rows in best["runs"] for row in rows]]
    classical = best[best["field"] == "classical"].groupby("scene_name").size()
    single = len(classical) == best["scene_name"].nunique() and (classical == 1).all()
    table = ablation(
        pd.concat([runs, frame[frame["state"] != "finished"]]),
        row_keys(runs),
        baseline={"field": "classical"} if single else None,
        title="Configurations over seeds",
    )
    return Table(table.title, table.text, table.data, table.bold, (*table.notes, *filter(None, [not_shown])))


def smallest_configurations(frame: pd.DataFrame) -> Table:
    return smallest(frame, row_keys(select(frame).runs))
