"""The forest plot: differences from the baseline with their intervals, a row a scene, and the band of equivalence."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from qnerf.metrics import metric_of

from .. import style
from ..selection import classical_baseline, main_metric, row_keys, select
from ..tables.scenes import across_scenes
from ..verdict import within_of

COLORS = {"better": "#117733", "worse": "#aa3322", "equivalent": "#0b5fa5", "undecided": "#888888"}
MAX_ROWS = 60


@style.styled
def forest(
    frame: pd.DataFrame,
    baseline: str | Mapping[str, object] | None = None,
    *,
    metric: str | None = None,
    within: float | None = None,
) -> Figure:
    """`across_scenes` of every setting that differs, by default against the classical configuration.

    A mark is a configuration in a scene with its 95 % interval, a diamond a mean over scenes; the band is ± the
    smallest difference that matters. ValueError as of `across_scenes`, and where a scene has no classical baseline.
    """
    selection = select(frame, metric := metric or main_metric(frame))
    runs = selection.runs
    rows = row_keys(runs)
    table = across_scenes(frame, rows, baseline or classical_baseline(runs, rows), metric=metric, within=within)
    known = table.data[table.data["freedom"] > 0]
    if known.empty:
        raise ValueError("no configuration has two seeds in common views with its scene's baseline")
    shown, left = known[:MAX_ROWS], len(table.data) - len(known[:MAX_ROWS])
    group = pd.factorize(shown["configuration"])[0]
    place = -np.arange(len(shown)) - 1.4 * group
    figure = style.new(style.PAGE, 1.0 + 0.2 * -place.min())
    ax = figure.subplots()
    least = within_of(metric, within, 0)
    ax.axvspan(-least, least, color=style.PALETTE[0], alpha=0.12, lw=0)
    ax.axvline(0, color=style.ink(), lw=0.7)
    means = shown["seeds"].map(any).map({True: "o", False: "D"})
    for (kind, mark), own in shown.assign(place=place).groupby(["kind", means]):
        ax.errorbar(own["difference"], own["place"], xerr=own["reach"], fmt=mark, color=COLORS[kind], ms=4, lw=1.2)
    for kind in shown["kind"].unique():
        ax.plot([], [], "o", color=COLORS[kind], label=kind)
    title = f"{metric_of(metric).label} minus the baseline's, {metric_of(metric).unit or 'in its own unit'}"
    ax.set(yticks=place, ylim=(place.min() - 0.8, 1.8), xlabel=title)
    ax.set_yticklabels(shown["scene"])
    ax.tick_params(axis="y", length=0)
    ax.grid(False, axis="y")
    for number in np.flatnonzero(np.diff(group, prepend=-1)):
        look = {"transform": ax.get_yaxis_transform(), "ha": "right", "va": "center", "weight": "bold"}
        ax.text(0, place[number] + 1.1, f"{shown['configuration'].iloc[number]} ", **look)
    style.legend(figure)
    style.footnote(figure, table.notes[0], selection.note, f"not drawn: {left} rows" if left else "")
    return figure
