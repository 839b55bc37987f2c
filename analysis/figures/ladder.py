"""Speed against error, rung by rung: what computing less costs, on the same weights and trained anew."""

from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from qnerf.metrics import metric_of

from .. import style

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "results" / "speed_error.parquet"


def ladder_points(results: str | Path | pd.DataFrame = BENCHMARK) -> pd.DataFrame:
    """One row a scene and rung, in the benchmark's order: scene, kind, rung, step_ms, psnr (dB, mean over the seeds),
    psnr_std (NaN for one seed), ssim, depth_error, image_error (root mean square), parameters, n.

    ValueError where there is no benchmark.
    """
    if not isinstance(results, pd.DataFrame):
        if not Path(results).is_file():
            raise ValueError(f"{results}: no benchmark; `python -m benchmarks.speed_error` writes it")
        results = pd.read_parquet(results)
    groups = results.groupby(["scene", "kind", "rung"], sort=False)
    table = groups[["step_ms", "psnr", "ssim", "depth_error", "image_error", "parameters"]].mean()
    return table.assign(psnr_std=groups["psnr"].std(), n=groups.size()).reset_index()


@style.styled
def speed_error_ladder(results: str | Path | pd.DataFrame = BENCHMARK) -> Figure:
    """Step time against PSNR of what was trained, and against the error of the picture on the same weights; one column
    a scene."""
    table = ladder_points(results)
    scenes = list(dict.fromkeys(table["scene"]))
    figure = style.new(style.PAGE, 5.2)
    axes = figure.subplots(2, len(scenes), squeeze=False)
    for column, scene in enumerate(scenes):
        for row, (kind, value) in enumerate((("trained", "psnr"), ("same weights", "image_error"))):
            own = table[(table["kind"] == kind) & (table[value] > 0)]
            _draw(axes[row, column], own[own["scene"] == scene], value, list(dict.fromkeys(own["rung"])))
        axes[0, column].set_title(scene)
        axes[1, column].set(yscale="log", xlabel="training step, ms")
    axes[0, 0].set_ylabel(metric_of("eval/psnr").heading)
    axes[1, 0].set_ylabel("picture, rms error against float64")
    handles = {text: handle for ax in axes.flat for handle, text in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside upper left", ncols=3)
    trained = table[table["kind"] == "trained"]
    least, most = int(trained["n"].min()), int(trained["n"].max())
    seeds = f"{least} seeds" if least == most else f"{least} to {most} seeds"
    style.footnote(figure, f"above: trained anew, {seeds}, bars: standard deviation; below: one run's weights", "")
    return figure


def _draw(ax: Axes, shown: pd.DataFrame, value: str, rungs: list[str]) -> None:
    """`rungs`: those of all scenes, which look alike in each."""
    for _, rung in shown.iterrows():
        number = rungs.index(rung["rung"])
        lap = number // len(style.MARKERS)  # the second time round, with other colours
        error = rung["psnr_std"] if value == "psnr" else float("nan")
        shift = 0 if value == "psnr" else 3  # other colours for the other kind of rungs
        ax.errorbar(
            rung["step_ms"],
            rung[value],
            yerr=error if error == error else None,
            fmt=style.MARKERS[number % len(style.MARKERS)],
            color=style.PALETTE[(number + shift + 2 * lap) % len(style.PALETTE)],
            mfc="none" if value != "psnr" else None,
            label=rung["rung"],
        )
    ax.set_xscale("log")
    ax.margins(0.12)
    style.plain_ticks(ax)
