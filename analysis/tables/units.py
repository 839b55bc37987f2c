"""Dead units of a head before and after training, from `qnerf probe RUN units`."""

import math
from collections.abc import Sequence

import pandas as pd

from qnerf.metrics import metric_of

from .. import packed
from ..selection import check_keys, label, refuse_mixtures, select
from .seeds import mean_and_spread
from .table import Table


def units(frame: pd.DataFrame, rows: Sequence[str], *, head: str = "color") -> Table:
    """Dead hidden units and the spread of the raw outputs of `head`, as means over the seeds of each group.

    Dead: share of all hidden ReLU units that are 0 on all samples of 1,024 training rays. Spread: standard deviation
    of the values before the sigmoid over those samples. Runs that were not probed are left out. Raises ValueError as
    `over_seeds` does, and where no run was probed.
    """
    check_keys(frame, rows)
    selection = select(frame)
    refuse_mixtures(selection.runs, rows)
    tables, damaged = packed.probe_tables(selection.runs["path"], "units")
    probed = selection.runs[selection.runs["path"].isin(list(tables))]
    if probed.empty:
        raise ValueError(damaged or "no run was probed: qnerf probe RUN units")
    columns = pd.DataFrame([_measured(tables[path], head) for path in probed["path"]], index=probed.index)
    groups = pd.concat([probed[[*rows, "psnr"]], columns], axis=1).groupby(list(rows), dropna=False)
    data = groups.mean().assign(n=groups.size())
    text = pd.DataFrame({name: data.index.get_level_values(name).map(label) for name in data.index.names})
    psnr = groups["psnr"].agg(["mean", "std", "count"]).to_numpy()
    text[metric_of("psnr").heading] = [mean_and_spread("psnr", mean, std, int(n), int(n)) for mean, std, n in psnr]
    for name in columns:
        form = "{:.0%}" if name.startswith("dead") else "{:.2g}"
        text[name] = ["" if pd.isna(number) else form.format(number) for number in data[name]]
    text["seeds"] = data["n"].astype(str).to_numpy()
    left = len(selection.runs) - len(probed)
    notes = [
        f"of the {head} head, on 1,024 training rays; dead: hidden units that are 0 on all samples; spread: standard "
        "deviation of the raw values over the samples",
        *([f"left out: {left} not probed"] if left else []),
        *filter(None, [damaged, selection.note]),
    ]
    bold = pd.DataFrame(False, index=text.index, columns=text.columns)
    return Table("How alive it is", text, data, bold, tuple(notes))


def _measured(table: pd.DataFrame, head: str) -> dict[str, float]:
    """Of one run: share of dead units and spread of the raw values, at the start and the end."""
    result: dict[str, float] = {}
    for name, kind, column in (("dead", "relu", "dead"), ("spread", "output", "std")):
        for when in ("start", "end"):
            own = table[(table["head"] == head) & (table["when"] == when) & (table["kind"] == kind)]
            total = own["units"].sum()
            result[f"{name}, {when}"] = float((own[column] * own["units"]).sum() / total) if total else math.nan
    return result
