"""Dead units of a head before and after training, from `qnerf probe RUN units`."""

import math
from collections.abc import Sequence
from dataclasses import replace

import pandas as pd

from .. import packed
from ..selection import select
from .ablation import ablation
from .table import Table


def units(frame: pd.DataFrame, rows: Sequence[str], *, head: str = "color") -> Table:
    """Dead hidden units and the spread of the raw outputs of `head`, as means over the seeds of each group.

    Dead: share of all hidden ReLU units that are 0 on all samples of 1,024 training rays. Spread: standard deviation
    of the values before the sigmoid over those samples. Runs that were not probed are left out. Raises ValueError as
    `select` does, and where no run was probed.
    """
    selection = select(frame)
    tables, damaged = packed.probe_tables(selection.runs["path"], "units")
    if not tables:
        raise ValueError(damaged or "no run was probed: qnerf probe RUN units")
    columns = pd.DataFrame.from_dict({path: _measured(table, head) for path, table in tables.items()}, orient="index")
    probed = frame[frame["path"].isin(list(tables))].join(columns, on="path")
    made = ablation(probed, rows, values=["psnr", *columns], title="How alive it is")
    left = len(selection.runs) - len(probed)
    notes = (
        f"of the {head} head, on 1,024 training rays; dead: hidden units that are 0 on all samples; spread: standard "
        "deviation of the raw values over the samples",
        f"left out: {left} not probed" if left else "",
        damaged,
    )
    return replace(made, notes=(*notes, *made.notes))


def _measured(table: pd.DataFrame, head: str) -> dict[str, float]:
    """Of one run: share of dead units and spread of the raw values, at the start and the end."""
    result: dict[str, float] = {}
    for name, kind, column in (("dead", "relu", "dead"), ("spread", "output", "std")):
        for when in ("start", "end"):
            own = table[(table["head"] == head) & (table["when"] == when) & (table["kind"] == kind)]
            total = own["units"].sum()
            result[f"{name} @ {when}"] = float((own[column] * own["units"]).sum() / total) if total else math.nan
    return result
