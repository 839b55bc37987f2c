"""The forest plot: differences from the baseline with their intervals, a row a scene, and the band of equivalence."""

from collections.abc import Mapping, Sequence

import pandas as pd
from matplotlib.figure import Figure

from qnerf.metrics import metric_of

from .. import style
from ..selection import classical_baseline, row_keys, select
from ..tables.scenes import Compared, compared
from ..verdict import within_of

COLORS = {"better": "#117733", "worse": "#aa3322", "equivalent": "#0b5fa5", "undecided": "#888888"}
MAX_ROWS = 60


def forest_points(
    frame: pd.DataFrame,
    rows: Sequence[str] | None = None,
    baseline: str | Mapping[str, object] | None = None,
    *,
    metric: str = "psnr",
    within: float | None = None,
) -> tuple[list[Compared], list[str]]:
    """What the plot draws, and notes; by default every setting that differs, against the classical configuration.

    ValueError where the baseline is not given and a scene has no single classical configuration.
    """
    runs = select(frame, metric).runs
    rows = list(rows or row_keys(runs))
    return compared(frame, rows, baseline or classical_baseline(runs, rows), metric=metric, within=within)


@style.styled
def forest(
    frame: pd.DataFrame,
    rows: Sequence[str] | None = None,
    baseline: str | Mapping[str, object] | None = None,
    *,
    metric: str = "psnr",
    within: float | None = None,
) -> Figure:
    """A mark a configuration and scene with its 95 % interval; the shaded band is ± the smallest difference that
    matters. Diamonds are means over scenes. Arguments as `forest_points`."""
    lines, notes = forest_points(frame, rows, baseline, metric=metric, within=within)
    shown = [line for line in lines if line.verdict.freedom][:MAX_ROWS]
    if not shown:
        raise ValueError("no configuration has two seeds in common views with its scene's baseline")
    least = within_of(metric, within)
    figure = style.new(style.PAGE, 0.9 + 0.22 * len(shown) + 0.3 * len({line.configuration for line in shown}))
    ax = figure.subplots()
    ax.axvspan(-least, least, color=style.PALETTE[0], alpha=0.12, lw=0)
    ax.axvline(0, color=style.ink(), lw=0.7)
    ticks: list[float] = []
    names: list[str] = []
    place = 0.0
    for number, line in enumerate(shown):
        if number == 0 or line.configuration != shown[number - 1].configuration:
            place -= 1.4
            ticks, names = [*ticks, place + 0.2], [*names, line.configuration]
        place -= 1
        ticks, names = [*ticks, place], [*names, line.scene]
        found, mean = line.verdict, not any(line.verdict.seeds)
        look = {"fmt": "D" if mean else "o", "color": COLORS[found.kind], "ms": 5 if mean else 4, "lw": 1.2}
        ax.errorbar(found.difference, place, xerr=found.reach, **look)
    ax.set(
        yticks=ticks, ylim=(place - 0.8, 0), xlabel=f"{metric_of(metric).label} minus the baseline's, {_unit(metric)}"
    )
    ax.set_yticklabels(names)
    heads = {line.configuration for line in shown}
    for text in ax.get_yticklabels():
        text.set_fontweight("bold" if text.get_text() in heads else "normal")
    ax.tick_params(axis="y", length=0)
    ax.grid(False, axis="y")
    for kind in dict.fromkeys(line.verdict.kind for line in shown):
        ax.plot([], [], "o", color=COLORS[kind], label=kind)
    style.legend(figure)
    left = f"not drawn: {len(lines) - len(shown)} rows" if len(lines) > len(shown) else ""
    style.footnote(figure, *notes, left)
    return figure


def _unit(metric: str) -> str:
    return metric_of(metric).unit or "in its own unit"
