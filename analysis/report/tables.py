"""Tables of the page and their copies as text; a table that cannot be made is a line that says why."""

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd

from ..decide.records import records
from ..figures import points
from ..figures.files import collecting
from ..selection import classical_baseline, label, main_metric, row_keys, select
from ..tables import Table, resources

MAX_ERROR = 600  # characters of an error that may list every column
DECIDED = ("scene", "candidate", "baseline", "verdict", "difference", "seeds")  # the first columns of studies
MAX_ROWS = 30  # configurations of a scene in the ablation table


@dataclass(frozen=True)
class ShownTable:
    """A table of the page under its title; or why it is `absent`."""

    title: str
    table: Table | None = None
    absent: str = ""


def attempt(title: str, make: Callable[..., Table], *arguments: Any) -> ShownTable:
    """The table under this title, or why it cannot be made."""
    errors: dict[str, str] = {}
    with collecting(errors, title):
        return ShownTable(title, make(*arguments))
    return ShownTable(title, absent=f"{errors[title][:MAX_ERROR]}.")


def over_seeds(
    frame: pd.DataFrame,
    baseline: str | Mapping[str, object] | None = None,
    metric: str | None = None,
    within: float | None = None,
) -> Table:
    """`resources` of the best `MAX_ROWS` configurations of each scene, by default against the classical one if any."""
    metric = metric or main_metric(frame)
    runs = select(frame, metric).runs
    best, not_shown = points.best(runs, [metric], MAX_ROWS)
    runs = runs.loc[[row for rows in best["runs"] for row in rows]]
    rows = row_keys(runs)
    with contextlib.suppress(ValueError):
        baseline = baseline or classical_baseline(runs, rows)
    table = resources(
        pd.concat([runs, frame[frame["state"] != "finished"]]),
        rows,
        metric=metric,
        baseline=baseline,
        within=within,
        title="Configurations over seeds",
    )
    same = [key for key in rows[:-1] if runs[key].nunique(dropna=False) == 1]
    said = ", ".join(f"{key} {label(runs[key].iloc[0])}" for key in same)
    everywhere = f"in all rows: {said}" if same else ""
    return replace(table, text=table.text.drop(columns=same), notes=(everywhere, *table.notes, not_shown))


def decisions(store: str | Path) -> ShownTable | None:
    """What `qnerf decide` has decided in this store; None where nothing was asked."""
    found = records(store)
    if found.empty:
        return None
    found = found.dropna(axis=1, how="all").loc[:, found.astype(str).ne("").any()]
    found = found.drop(columns=["difference", "reach", "about"], errors="ignore").rename(
        columns={"shown": "difference"}
    )
    found = found[sorted(found, key=lambda name: DECIDED.index(name) if name in DECIDED else len(DECIDED))]
    text = found.map(
        lambda value: (
            "" if value is None or value != value else f"{value:.4g}" if isinstance(value, float) else str(value)
        )
    )
    title = "Decided by qnerf decide: at most 5 % wrong over all looks"
    return ShownTable(title, Table(title, text, found, notes=("spent: the error rate of the last look",)))
