"""How often a configuration fails: its worst seed, and how many seeds are far below the others."""

from collections.abc import Sequence

import pandas as pd

from qnerf.metrics import metric_of

from ..selection import SCENES, label, select
from ..verdict import SLIP
from .seeds import mean_and_spread
from .table import Table

COLLAPSE = 5.0  # dB


def stability(frame: pd.DataFrame, rows: Sequence[str]) -> Table:
    """PSNR of the median, worst and best seed of each group of `rows`, and how many seeds slipped or collapsed.

    A run slipped if it is more than 1.5 dB below the median of its row. It collapsed if it is more than 5 dB below the
    highest median of its scene. Raises ValueError as `select` does.
    """
    selection = select(frame, rows=rows)
    scenes = [key for key in rows if key in SCENES]
    groups = selection.runs.groupby(list(rows), dropna=False)["psnr"]
    data = groups.agg(["mean", "std", "median", "min", "max", "count"])
    data = data.rename(columns={"min": "worst", "max": "best", "count": "n"})
    best = data["median"].groupby(scenes, dropna=False).transform("max") if scenes else data["median"].max()
    for name, limit in (("slipped", data["median"] - SLIP), ("collapsed", best - COLLAPSE + 0 * data["median"])):
        data[name] = [int((values < least).sum()) for (_, values), least in zip(groups, limit, strict=True)]
    text = pd.DataFrame({name: data.index.get_level_values(name).map(label) for name in data.index.names})
    spread = data[["mean", "std", "n"]].to_numpy()
    text[metric_of("psnr").heading] = [mean_and_spread("psnr", mean, std, n, n) for mean, std, n in spread]
    for name in ("median", "worst", "best"):
        text[name] = data[name].map(metric_of("psnr").text).to_numpy()
    for name in ("slipped", "collapsed"):
        text[name] = [f"{count} of {n}" for count, n in zip(data[name], data["n"], strict=True)]
    note = (
        f"slipped: more than {SLIP:g} dB below the row's median; "
        f"collapsed: more than {COLLAPSE:g} dB below the highest median of the scene"
    )
    return Table("How often it fails", text, data, notes=(note, selection.note))
