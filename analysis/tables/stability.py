"""How often a configuration fails: the spread of its seeds, told by the worst of them."""

from collections.abc import Sequence

import pandas as pd

from analysis.selection import SCENES, check_keys, label, refuse_mixtures, select
from analysis.tables.seeds import aggregate
from analysis.tables.table import Table
from analysis.tables.values import shown, value

SLIP, COLLAPSE = 1.5, 5.0  # dB


def stability(frame: pd.DataFrame, rows: Sequence[str], *, metric: str = "psnr") -> Table:
    """Median, worst and best seed of each group of `rows`, and how many seeds slipped or collapsed.

    A run slipped that is more than 1.5 dB below its row's median; it collapsed where it is more than 5 dB below the
    highest median of its scene. Raises ValueError as `over_seeds` does, and for a metric that is not in dB.
    """
    if metric != "psnr" and not metric.endswith("/psnr"):
        raise ValueError(f"stability counts dB: expected psnr, got {metric}")
    check_keys(frame, rows)
    selection = select(frame, metric)
    runs = selection.runs
    refuse_mixtures(runs, rows)
    scenes = [key for key in rows if key in SCENES]
    medians = runs.groupby(list(rows), dropna=False)[metric].median()
    top = medians.groupby(scenes, dropna=False).transform("max") if scenes else medians * 0 + medians.max()
    groups = runs.groupby(list(rows), dropna=False)[metric]
    data = groups.agg(["median", "min", "max", "size"]).set_axis(["median", "worst", "best", "n"], axis=1)
    for name, limit in (("slipped", medians - SLIP), ("collapsed", top - COLLAPSE)):
        data[name] = [int((values < least).sum()) for (_, values), least in zip(groups, limit, strict=True)]
    spread = aggregate(runs, rows, [metric])[metric]
    text = pd.DataFrame({name: data.index.get_level_values(name).map(label) for name in data.index.names})
    text[value(metric).heading] = [shown(metric, *row, row[2]) for row in spread[["mean", "std", "n"]].to_numpy()]
    for name in ("median", "worst", "best"):
        text[name] = data[name].map(value(metric).form.format).to_numpy()
    for name in ("slipped", "collapsed"):
        text[name] = [f"{count} of {n}" for count, n in zip(data[name], data["n"], strict=True)]
    notes = [
        f"slipped: more than {SLIP:g} dB below the row's median; "
        f"collapsed: more than {COLLAPSE:g} dB below the highest median of the scene"
    ]
    bold = pd.DataFrame(False, index=text.index, columns=text.columns)
    return Table("How often it fails", text, data, bold, (*notes, *filter(None, [selection.note])))
