"""Speed against error: which configurations, and which engines, nothing beats in both."""

from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from qnerf.metrics import metric_of

from .. import style
from ..selection import select
from . import points

TIMES = ("step_ms", "train_s")
BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "results" / "quantum.parquet"


def front(cost: pd.Series, loss: pd.Series) -> pd.Series:
    """Which points no other beats: none has less or equal of both and less of one. NaN is never on the front."""
    c, v = cost.to_numpy(float), loss.to_numpy(float)
    no_worse = (c[:, None] <= c) & (v[:, None] <= v)
    better = (c[:, None] < c) | (v[:, None] < v)
    return ~(no_worse & better).any(axis=0) & cost.notna() & loss.notna()


def speed_points(frame: pd.DataFrame, time: str = "step_ms", metric: str = "psnr") -> pd.DataFrame:
    """`points.points` of an image metric and a time with `front`: whether no other of its scene beats it.

    ValueError for another time.
    """
    if time not in TIMES:
        raise ValueError(f"unknown time {time!r}; known: {', '.join(TIMES)}")
    table = points.points(select(frame, metric).runs, [metric, time])
    for _, rows in table.groupby("scene_name"):
        table.loc[rows.index, "front"] = front(rows[time], -metric_of(metric).sign * rows[metric])
    return table.astype({"front": bool})


@style.styled
def speed_vs_error(frame: pd.DataFrame, time: str = "step_ms", metric: str = "psnr") -> Figure:
    """An image metric against a time, one panel a scene, with the Pareto front drawn and its points named."""
    table = speed_points(frame, time, metric)
    scenes = points.scenes(table)
    figure = style.new(style.COLUMN if len(scenes) == 1 else style.PAGE, 3.1)
    axes = figure.subplots(1, len(scenes), squeeze=False)[0]
    named = []
    for ax, scene in zip(axes, scenes, strict=True):
        shown = table[table["scene_name"] == scene]
        for field, group in shown.groupby("field"):
            color, marker = style.FIELDS[str(field)]
            bars = {"yerr": group[f"{metric}_std"], "xerr": group[f"{time}_std"], "elinewidth": 0.7}
            ax.errorbar(group[time], group[metric], fmt=marker, color=color, label=field, **bars)
        on = shown[shown["front"]].sort_values(time)
        ax.step(on[time], on[metric], where="post", color=style.ink(), lw=0.8, alpha=0.6, zorder=1)
        for number, (_, row) in enumerate(on.iterrows()):
            named.append(f"{len(named) + 1}  {row['name']}" + (f" ({scene})" if len(scenes) > 1 else ""))
            offset = (-6 - 9 * (number % 2), 4)  # neighbours on the front may lie close together
            ax.annotate(f"{len(named)}", (row[time], row[metric]), offset, textcoords="offset points", ha="right")
        ax.set(title=scene, xlabel=metric_of(time).heading, xscale="log")
        ax.set_xlim(shown[time].min() / 1.5, shown[time].max() * 1.3)
        ax.margins(y=0.12)
        style.plain_ticks(ax)
        ax.legend()
    axes[0].set_ylabel(metric_of(metric).heading)
    invisible = [Line2D([], [], ls="") for _ in named]
    figure.legend(invisible, named, loc="outside upper left", handlelength=0, ncols=len(scenes))
    style.footnote(figure, "line and numbers: Pareto front", points.seeds(table), select(frame, metric).note)
    return figure


def engine_points(results: str | Path | pd.DataFrame = BENCHMARK) -> pd.DataFrame:
    """Engines that ran in a benchmark of the quantum layer: engine, S, wires, batch, ms, error, front (of its S).

    `ms`: forward and backward; `error`: the largest of the outputs against float64 default.qubit. Those that gave no
    result have NaN. ValueError where there is no benchmark.
    """
    if not isinstance(results, pd.DataFrame):
        if not Path(results).is_file():
            raise ValueError(f"{results}: no benchmark; `python -m benchmarks.quantum` writes it")
        results = pd.read_parquet(results)
    table = results[["engine", "S", "wires", "batch", "ms", "note"]].assign(error=results["error_outputs"])
    for _, rows in table.groupby("S"):
        table.loc[rows.index, "front"] = front(rows["ms"], rows["error"])
    return table.astype({"front": bool})


@style.styled
def engine_speed_vs_error(results: str | Path | pd.DataFrame = BENCHMARK) -> Figure:
    """Time of a forward and backward pass against numerical error, one panel a number of re-uploadings S."""
    table = engine_points(results)
    ran = table[table["ms"].notna() & table["error"].notna()]
    engines = list(dict.fromkeys(ran.sort_values("ms")["engine"]))
    figure = style.new(style.PAGE, 3.1)
    axes = figure.subplots(1, ran["S"].nunique(), sharex=True, sharey=True, squeeze=False)[0]
    for ax, (spectral, shown) in zip(axes, ran.groupby("S"), strict=True):
        for _, row in shown.iterrows():
            number = engines.index(row["engine"])
            own = row["engine"].startswith("qnerf")
            color = style.PALETTE[number % len(style.PALETTE)]
            ax.plot(
                row["ms"],
                row["error"],
                ls="",
                marker=style.MARKERS[number % len(style.MARKERS)],
                color=color,
                mfc=color if own else "none",
                label=row["engine"],
            )
        on = shown[shown["front"]].sort_values("ms")
        ax.step(on["ms"], on["error"], where="post", color=style.ink(), lw=0.7, alpha=0.6, zorder=1)
        ax.set(title=f"S = {spectral}", xlabel="forward + backward, ms", xscale="log", yscale="log")
        ax.margins(0.12)
    axes[0].set_ylabel("largest absolute error of an output")
    style.legend(figure)
    first, missing = table.iloc[0], table[table["ms"].isna()].groupby("engine").size()
    absent = f"no result: {', '.join(missing.index)}" if len(missing) else ""
    style.footnote(
        figure,
        f"{first['wires']} wires, {first['batch']:,} samples, float32; filled: this project; line: Pareto front",
        absent,
    )
    return figure
