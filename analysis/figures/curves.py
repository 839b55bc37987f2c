"""What happens while training: losses against steps, held-out PSNR against time."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from qnerf.metrics import metric_of

from .. import style
from ..load import metrics
from ..selection import select
from . import points

MOST = 6  # configurations in one panel
BINS = 50  # points of a training curve


def loss_points(frame: pd.DataFrame, most: int = MOST) -> pd.DataFrame:
    """Mean squared colour error against steps, over the seeds of the `most` best configurations of each scene.

    Columns scene_name, name, split (train | eval), step, mse (geometric mean over seeds), mse_low and mse_high (one
    standard deviation of its logarithm; NaN for one seed), n. The training error is the mean over up to `BINS` equal
    spans of steps, each at its last one. The evaluation's is 10^(-PSNR / 10): a geometric mean over held-out views.
    Steps that not all seeds came to are left out.
    """
    table, _ = points.best(select(frame).runs, ["psnr"], most)
    parts = []
    for _, row in table.iterrows():
        train = _binned([metrics(path, "train/mse") for path in _paths(frame, row)])
        for logged in train:
            logged["value"] = -10 * np.log10(logged["value"])
        for split, logged in (("train", train), ("eval", [metrics(path, "eval/psnr") for path in _paths(frame, row)])):
            decibels = _over_seeds(logged, ["value"])
            rows = decibels[["step", "n"]].assign(scene_name=row["scene_name"], name=row["name"], split=split)
            for column, deviations in (("mse", 0), ("mse_low", 1), ("mse_high", -1)):
                shift = deviations * decibels["value_std"] if deviations else 0
                rows[column] = 10 ** (-(decibels["value"] + shift) / 10)
            parts.append(rows)
    return pd.concat(parts, ignore_index=True)


@style.styled
def loss_curves(frame: pd.DataFrame, most: int = MOST) -> Figure:
    """Colour error of training (solid) and of held-out views (dashed) against steps, one panel a scene."""
    curves = loss_points(frame, most)
    table, note = points.best(select(frame).runs, ["psnr"], most)
    figure, axes = _panels(points.scenes(table), sharey=True)
    order = list(dict.fromkeys(curves["name"]))
    for ax, (scene, shown) in zip(axes, curves.groupby("scene_name"), strict=True):
        for (name, split), curve in shown.groupby(["name", "split"], sort=False):
            look = style.series(order.index(name))
            train = split == "train"
            ax.plot(
                curve["step"], curve["mse"], "-" if train else "--", color=look["color"], ms=3.5,
                marker="" if train else look["marker"], label=None if train else name,
            )  # fmt: skip
            ax.fill_between(curve["step"], curve["mse_low"], curve["mse_high"], color=look["color"], alpha=0.18, lw=0)
        ax.set(title=scene, xlabel="optimisation step", yscale="log")
    axes[0].set_ylabel(metric_of("mse").heading)
    style.legend(figure, columns=1 if len(axes) == 1 else 2)
    lines = "solid: training; dashed: held out, 10^(-PSNR/10), of the first train.eval_views views"
    style.footnote(figure, lines, points.seeds(table, "bands"), note, select(frame).note)
    return figure


def time_points(frame: pd.DataFrame, most: int = MOST) -> pd.DataFrame:
    """Held-out PSNR against wall time, over the seeds of the `most` best configurations of each scene.

    Columns scene_name, name, step, time_s (mean seconds of training so far), psnr (dB), psnr_std, n.
    """
    table, _ = points.best(select(frame).runs, ["psnr"], most)
    parts = []
    for _, row in table.iterrows():
        rows = _over_seeds([metrics(path, "eval/psnr") for path in _paths(frame, row)], ["value", "time_s"])
        rows = rows.rename(columns={"value": "psnr", "value_std": "psnr_std"})
        parts.append(rows.assign(scene_name=row["scene_name"], name=row["name"]))
    return pd.concat(parts, ignore_index=True)


@style.styled
def psnr_vs_time(frame: pd.DataFrame, most: int = MOST) -> Figure:
    """Held-out PSNR against seconds of training, one panel a scene."""
    curves = time_points(frame, most)
    table, note = points.best(select(frame).runs, ["psnr"], most)
    figure, axes = _panels(points.scenes(table), sharey=False)
    order = list(dict.fromkeys(curves["name"]))
    for ax, (scene, shown) in zip(axes, curves.groupby("scene_name"), strict=True):
        for name, curve in shown.groupby("name", sort=False):
            bars = {"yerr": curve["psnr_std"], "elinewidth": 0.7}
            ax.errorbar(curve["time_s"], curve["psnr"], label=name, **bars, **style.series(order.index(name)))
        ax.set(title=scene, xlabel="training time, s")
    axes[0].set_ylabel(metric_of("eval/psnr").heading)
    style.legend(figure, columns=1 if len(axes) == 1 else 2)
    views = "of the first train.eval_views views"
    style.footnote(figure, views, points.seeds(table), note, select(frame).note)
    return figure


def _paths(frame: pd.DataFrame, row: pd.Series) -> list[str]:
    return [frame["path"][index] for index in row["runs"]]


def _binned(logged: list[pd.DataFrame]) -> list[pd.DataFrame]:
    """Of each seed the mean value over up to `BINS` spans of steps, the same for all, at the last step of each."""
    steps = np.unique(np.concatenate([rows["step"] for rows in logged]))
    ends = steps[::-1][:: -(-len(steps) // BINS)][::-1]
    binned = []
    for rows in logged:
        end = ends[np.searchsorted(ends, rows["step"])]
        binned.append(rows.assign(step=end).groupby("step", as_index=False).agg({"time_s": "last", "value": "mean"}))
    return binned


def _over_seeds(logged: list[pd.DataFrame], columns: list[str]) -> pd.DataFrame:
    """At the steps that all seeds came to."""
    rows = pd.concat(logged)
    groups = rows[rows.groupby("step")["step"].transform("size") == len(logged)].groupby("step")
    table = pd.DataFrame({"n": groups.size()})
    for column in columns:
        table[column], table[f"{column}_std"] = groups[column].mean(), groups[column].std()
    return table.reset_index()


def _panels(scenes: list[str], *, sharey: bool) -> tuple[Figure, np.ndarray]:
    figure = style.new(style.COLUMN if len(scenes) == 1 else style.PAGE, 3.2)
    return figure, figure.subplots(1, len(scenes), sharey=sharey, squeeze=False)[0]
