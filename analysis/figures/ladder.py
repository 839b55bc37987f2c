"""What each way to compute less gains in time and costs in quality, on the same weights and when trained with it."""

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from qnerf.metrics import metric_of

from .. import style
from . import benchmarks


def ladder_points(results: benchmarks.Results = None) -> pd.DataFrame:
    """Means over the seeds of the benchmark speed_error, a row per scene and rung in the benchmark's order.

    Columns scene, kind (trained | same weights), rung, step_ms, psnr (dB), ssim, depth_error, image_error (root mean
    square), parameters, psnr_std (NaN for one seed), n.
    """
    groups = benchmarks.read("speed_error", results).groupby(["scene", "kind", "rung"], sort=False)
    table = groups[["step_ms", "psnr", "ssim", "depth_error", "image_error", "parameters"]].mean()
    return table.assign(psnr_std=groups["psnr"].std(), n=groups.size()).reset_index()


@style.styled
def speed_error_ladder(results: benchmarks.Results = None) -> Figure:
    """Against the time of a training step, a column per scene.

    Above: PSNR of runs that were trained with each rung. Below: error of the picture that each rung renders from the
    same weights.
    """
    table = ladder_points(results)
    scenes = list(dict.fromkeys(table["scene"]))
    figure = style.new(style.PAGE, 5.0)
    halves = figure.subfigures(2, 1)
    for half, kind, value in zip(halves, ("trained", "same weights"), ("psnr", "image_error"), strict=True):
        shown = table[(table["kind"] == kind) & (table[value] > 0)]
        axes = half.subplots(1, len(scenes), squeeze=False)[0]
        for ax, scene in zip(axes, scenes, strict=True):
            _draw(ax, shown[shown["scene"] == scene], value, list(dict.fromkeys(shown["rung"])))
            ax.set(title=scene, xlabel="training step, ms")
            if kind != "trained":
                ax.set_yscale("log")
        axes[0].set_ylabel(
            metric_of("eval/psnr").heading if kind == "trained" else "picture, rms error\nagainst float64"
        )
        style.legend(half)
    counts = sorted(table.loc[table["kind"] == "trained", "n"].unique())
    seeds = " to ".join(str(n) for n in dict.fromkeys((counts[0], counts[-1])))
    style.footnote(figure, f"above: trained anew, {seeds} seeds, bars: standard deviation; below: one run's weights")
    return figure


def _draw(ax: Axes, shown: pd.DataFrame, value: str, rungs: list[str]) -> None:
    """Draws a point per row; The place in `rungs`, which lists the rungs of all scenes, decides its look."""
    trained = value == "psnr"
    for _, rung in shown.iterrows():
        number = rungs.index(rung["rung"])
        lap = number // len(style.MARKERS)  # markers repeat from here on, in other colours
        ax.errorbar(
            rung["step_ms"],
            rung[value],
            yerr=rung["psnr_std"] if trained and rung["n"] > 1 else None,
            fmt=style.MARKERS[number % len(style.MARKERS)],
            color=style.PALETTE[(number + 2 * lap) % len(style.PALETTE)],
            elinewidth=0.7,
            label=rung["rung"],
        )
    ax.set_xscale("log")
    ax.margins(0.12)
    style.plain_ticks(ax)
