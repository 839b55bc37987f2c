"""Speed against error: the configurations, and the engines, that no other beats in both."""

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from qnerf.metrics import METRICS, metric_of

from .. import style
from ..marks import Mark, write_names
from ..selection import select
from ..step_times import incomparable
from . import benchmarks, points

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
    return _with_fronts(table, "scene_name", table[time], -metric_of(metric).sign * table[metric])


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
        _draw_front(ax, shown, time, metric, lw=0.8)
        ax.set(title=scene, xlabel=metric_of(time).heading, xscale="log")
        ax.margins(0.15)
        style.plain_ticks(ax)
    axes[0].set_ylabel(metric_of(metric).heading)
    style.legend(figure)
    ranked = incomparable(finished.runs, time) or "line and names: Pareto front"
    style.footnote(figure, ranked, points.seeds(table), key, finished.note)
    write_names(figure, drawn)
    return figure


def engine_points(results: benchmarks.Results = None) -> pd.DataFrame:
    """The benchmark of the quantum layer: engine, S, wires, batch, ms, note, error, front.

    ms: time of a forward and backward pass; error: the largest of an output against float64 default.qubit, absolute;
    both are NaN for an engine without a result. front: whether the engine is on the Pareto front of its S.
    """
    results = benchmarks.read("quantum", results)
    table = results[["engine", "S", "wires", "batch", "ms", "note"]].assign(error=results["error_outputs"])
    return _with_fronts(table, "S", table["ms"], table["error"])


@style.styled
def engine_speed_vs_error(results: benchmarks.Results = None) -> Figure:
    """Time of a forward and backward pass against numerical error, a panel per number of re-uploadings S."""
    table = engine_points(results)
    ran = table.dropna(subset=["ms", "error"])
    engines = list(dict.fromkeys(ran.sort_values("ms")["engine"]))
    figure = style.new(style.PAGE, 3.1)
    axes = figure.subplots(1, ran["S"].nunique(), sharex=True, sharey=True, squeeze=False)[0]
    for ax, (spectral, shown) in zip(axes, ran.groupby("S"), strict=True):
        for _, row in shown.iterrows():
            look = style.series(engines.index(row["engine"]))
            face = look["color"] if row["engine"].startswith("qnerf") else style.paper()
            ax.plot(row["ms"], row["error"], ls="", mfc=face, mew=0.8, label=row["engine"], **look)
        _draw_front(ax, shown, "ms", "error", lw=0.7)
        ax.set(title=f"S = {spectral}", xlabel="forward + backward, ms", xscale="log", yscale="log")
        ax.margins(0.12)
        style.plain_ticks(ax)
    axes[0].set_ylabel("largest absolute error of an output")
    style.legend(figure)
    first, missing = table.iloc[0], sorted(table.loc[table["ms"].isna(), "engine"].unique())
    style.footnote(
        figure,
        f"{first['wires']} wires, {first['batch']:,} samples, float32; filled: this project; line: Pareto front",
        f"no result: {', '.join(missing)}" if missing else "",
    )
    return figure


def _with_fronts(table: pd.DataFrame, by: str, cost: pd.Series, loss: pd.Series) -> pd.DataFrame:
    """The table with the column `front`, one front per value of the column `by`."""
    fronts = [front(cost[rows.index], loss[rows.index]) for _, rows in table.groupby(by)]
    return table.assign(front=pd.concat(fronts))


def _draw_front(ax: Axes, shown: pd.DataFrame, x: str, y: str, lw: float) -> None:
    """Draws the front as steps."""
    best = shown[shown["front"]].sort_values(x)
    ax.step(best[x], best[y], where="post", color=style.ink(), lw=lw, alpha=0.6, zorder=1)
