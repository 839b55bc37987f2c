"""Speed against error: the configurations that no other beats in both."""

import pandas as pd
from matplotlib.figure import Figure

from qnerf.metrics import METRICS, metric_of

from .. import style
from ..marks import Mark, write_names
from ..selection import select
from ..step_times import incomparable
from . import points

COSTS = ("step_ms", "step_cpu_ms", "train_s", *(key for key, metric in METRICS.items() if metric.kind == "size"))


def front(cost: pd.Series, loss: pd.Series) -> pd.Series:
    """Which points are on the Pareto front: no other has at most their cost and loss, and less of one.

    A point with a NaN is never on it.
    """
    c, v = cost.to_numpy(float), loss.to_numpy(float)
    no_worse = (c[:, None] <= c) & (v[:, None] <= v)
    better = (c[:, None] < c) | (v[:, None] < v)
    beaten = pd.Series((no_worse & better).any(axis=0), index=cost.index)
    return cost.notna() & loss.notna() & ~beaten


def speed_points(frame: pd.DataFrame, time: str = "step_ms", metric: str = "psnr") -> pd.DataFrame:
    """`points.points` of an image metric and a time, with `front`: whether the row is on its scene's Pareto front.

    There is no front where the times are not comparable (`step_times.incomparable`).

    time: step_ms, the median time of a step; step_cpu_ms, its CPU time; train_s, seconds of training; or a number of
        parameters instead, such as params.total. ValueError for any other.
    """
    if time not in COSTS:
        raise ValueError(f"unknown cost {time!r}; known: {', '.join(COSTS)}")
    runs = select(select(frame, metric).runs, time).runs
    table = points.points(runs, [metric, time])
    if incomparable(runs, time):
        return table.assign(front=False)
    loss = -metric_of(metric).sign * table[metric]
    fronts = [front(rows[time], loss[rows.index]) for _, rows in table.groupby("scene_name")]
    return table.assign(front=pd.concat(fronts))


@style.styled
def speed_vs_error(frame: pd.DataFrame, time: str = "step_ms", metric: str = "psnr") -> Figure:
    """An image metric against a time, a panel per scene. A line marks the Pareto front, whose marks have names."""
    table = speed_points(frame, time, metric)  # refuses an unknown cost
    finished = select(select(frame, metric).runs, time)
    table["mark"], key = points.marked(
        table, finished.runs, [head for head in style.HEADS if table[head].nunique() > 1]
    )
    scenes = points.scenes(table)
    figure, axes = style.panels(len(scenes), 2.6)
    drawn = []
    for ax, scene in zip(axes, scenes, strict=True):
        shown = table[table["scene_name"] == scene]
        for field, group in shown.groupby("field"):
            color, marker = style.look_of(str(field))
            ax.errorbar(group[time], group[metric], xerr=group[f"{time}_std"], fmt="none", ecolor=color, elinewidth=0.7)
            ax.plot([], [], ls="", marker=marker, color=color, label=field)
            names = group["mark"].where(group["front"], "")
            values = zip(group[time], group[metric], group[f"{metric}_std"], names, strict=True)
            drawn += [Mark(ax, *value).draw(marker, color=color) for value in values]
        best = shown[shown["front"]].sort_values(time)
        ax.step(best[time], best[metric], where="post", color=style.ink(), lw=0.8, alpha=0.6, zorder=1)
        ax.set(title=scene, xlabel=metric_of(time).heading, xscale="log")
        ax.margins(0.15)
        style.plain_ticks(ax)
    axes[0].set_ylabel(metric_of(metric).heading)
    style.legend(figure)
    ranked = incomparable(finished.runs, time) or "line and names: Pareto front"
    style.footnote(figure, ranked, points.seeds(table), key, finished.note)
    write_names(figure, drawn)
    return figure
