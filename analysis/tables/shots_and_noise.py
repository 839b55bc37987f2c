"""PSNR of trained circuits with finite shots or noisy gates, from `qnerf probe RUN shots=... noise=...`."""

from collections.abc import Sequence

import pandas as pd

from .. import packed
from ..condition_means import CONDITION, FILE, condition_name, means
from ..selection import check_keys, label, refuse_mixtures, select
from .seeds import mean_and_spread
from .table import Table


def shots_and_noise(frame: pd.DataFrame, rows: Sequence[str]) -> Table:
    """PSNR (dB) of each condition, exact first, then by noise, its p and shots; means over views and seeds.

    `(n = 2)` marks a condition that only 2 of the row's seeds were measured under. Raises ValueError as `over_seeds`
    does, and where no run was measured.
    """
    check_keys(frame, rows)
    selection = select(frame)
    refuse_mixtures(selection.runs, rows)
    tables, damaged = packed.probe_tables(selection.runs["path"], FILE)
    measured = selection.runs[selection.runs["path"].isin(list(tables))]
    if measured.empty:
        raise ValueError(damaged or "no run was measured: qnerf probe RUN shots=100,1000")
    each = pd.concat([means(tables[run["path"]]).assign(**run[list(rows)]) for _, run in measured.iterrows()])
    exact_first = each.assign(noisy=each["noise"] != "none").sort_values(["noisy", "noise", "p", "shots"])
    order = exact_first[CONDITION].drop_duplicates().itertuples(index=False)
    columns = [condition_name(*condition) for condition in order]
    named = each.assign(condition=[condition_name(*row) for row in each[CONDITION].itertuples(index=False)])
    groups = named.groupby([*rows, "condition"], dropna=False)["psnr"]
    data = groups.agg(["mean", "std", "count"]).unstack("condition").swaplevel(axis=1)
    seeds = measured.groupby(list(rows), dropna=False).size()
    text = pd.DataFrame({name: data.index.get_level_values(name).map(label) for name in data.index.names})
    for column in columns:
        cells = zip(*(data[column][part] for part in ("mean", "std", "count")), seeds, strict=True)
        text[column] = [
            mean_and_spread("psnr", mean, std, int(n) if n == n else 0, int(of)) for mean, std, n, of in cells
        ]
    text["seeds"] = seeds.astype(str).to_numpy()
    data = pd.concat({column: data[column] for column in columns}, axis=1)
    left = len(selection.runs) - len(measured)
    notes = [
        "PSNR, dB, of the trained circuits with each value from that many shots, or an error of that probability at "
        "each gate",
        *([f"left out: {left} not measured"] if left else []),
        *filter(None, [damaged, selection.note]),
    ]
    bold = pd.DataFrame(False, index=text.index, columns=text.columns)
    return Table("On hardware", text, data, bold, tuple(notes))
