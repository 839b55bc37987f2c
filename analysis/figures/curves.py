"""What happens during training: losses against steps, PSNR of held-out views against time."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from qnerf.metrics import metric_of

from .. import style
from ..load import metrics
from ..selection import select
from ..step_times import incomparable
from . import points

MOST = 6  # configurations in one panel
BINS = 50  # points of a training curve


def loss_points(frame: pd.DataFrame, most: int = MOST) -> pd.DataFrame:
    """Mean squared colour error against steps, over the seeds of the `most` best configurations of each scene.

    The training error is averaged over up to `BINS` equal spans of steps; the error of held-out views is
    10^(-PSNR / 10). Columns step (the last of its span), n, mse (geometric mean over seeds), mse_low and mse_high (one
    standard deviation of its logarithm; NaN for one seed), split (train | eval), scene_name, name.
    """
    return _of_best(frame, most, "train/mse", _losses)


def time_points(frame: pd.DataFrame, most: int = MOST) -> pd.DataFrame:
    """PSNR of held-out views against wall time, over the seeds of the `most` best configurations of each scene.

    Columns step, n, psnr (dB), psnr_std, time_s (mean seconds of training so far), scene_name, name.
    """
    return _of_best(frame, most, "eval/psnr", _times)


@style.styled
def loss_curves(frame: pd.DataFrame, most: int = MOST) -> Figure:
    """Colour error of training (solid) and of held-out views (dashed) against steps, a panel per scene."""

    def draw(ax: Axes, name: str, curve: pd.DataFrame, color: str, marker: str) -> None:
        for split, part in curve.groupby("split", sort=False):
            look: dict[str, Any] = {"ls": "--", "marker": marker, "label": name} if split == "eval" else {}
            ax.plot(part["step"], part["mse"], color=color, ms=3.5, **look)
            ax.fill_between(part["step"], part["mse_low"], part["mse_high"], color=color, alpha=0.18, lw=0)

    figure, axes, note = _panels(frame, loss_points(frame, most), most, "train/mse", draw, "bands", sharey=True)
    for ax in axes:
        ax.set(xlabel="optimisation step", yscale="log")
        ax.xaxis.set_major_locator(MaxNLocator(4))
        ax.xaxis.set_major_formatter(style.PLAIN)
    axes[0].set_ylabel("mean squared colour error")
    lines = "solid: training; dashed: held out, 10^(-PSNR/10), of train.eval_views of the held-out views"
    style.footnote(figure, lines, note)
    return figure


@style.styled
def psnr_vs_time(frame: pd.DataFrame, most: int = MOST) -> Figure:
    """PSNR of held-out views against seconds of training, a panel per scene."""

    def draw(ax: Axes, name: str, curve: pd.DataFrame, **look: Any) -> None:
        ax.errorbar(curve["time_s"], curve["psnr"], curve["psnr_std"], elinewidth=0.7, label=name, **look)

    figure, axes, note = _panels(frame, time_points(frame, most), most, "eval/psnr", draw, "bars")
    for ax in axes:
        ax.set_xlabel(metric_of("train_s").heading)
    axes[0].set_ylabel(metric_of("eval/psnr").heading)
    style.footnote(
        figure, "of train.eval_views of the held-out views", note, incomparable(select(frame).runs, "train_s")
    )
    return figure


def _of_best(frame: pd.DataFrame, most: int, key: str, curve: Callable[[Sequence[str]], pd.DataFrame]) -> pd.DataFrame:
    """`curve` of the runs of each of the best configurations, with the columns scene_name and name."""
    table, _ = _best(frame, most, key)
    curves = [curve(frame["path"][row["runs"]]).assign(**row[["scene_name", "name"]]) for _, row in table.iterrows()]
    return pd.concat(curves, ignore_index=True)


def _best(frame: pd.DataFrame, most: int, key: str) -> tuple[pd.DataFrame, str]:
    """`points.best` of the runs that have logged this key, readably, and a note on names and on what is left out.

    ValueError with the reason if none has.
    """
    selection = select(frame)
    problems: dict[str, str] = {}
    for path in selection.runs["path"]:
        try:
            if metrics(path, key).empty:
                problems[path] = f"{path}: has not logged {key}"
        except ValueError as error:
            problems[path] = str(error)
    if len(problems) == len(selection.runs):
        raise ValueError(next(iter(problems.values())))
    table, rest = points.best(selection.runs[~selection.runs["path"].isin(list(problems))], ["psnr"], most)
    damaged = f"left out: {len(problems)} with missing or damaged metrics" if problems else ""
    return table, "; ".join(filter(None, [rest, damaged, points.notation(table["name"]), selection.note]))


def _losses(paths: Sequence[str]) -> pd.DataFrame:
    training = _binned([metrics(path, "train/mse") for path in paths])
    for logged in training:
        logged["value"] = -10 * np.log10(logged["value"])
    parts = []
    for split, decibels in (("train", training), ("eval", [metrics(path, "eval/psnr") for path in paths])):
        table = _over_seeds(decibels, ["value"])
        mean, std = table["value"], table["value_std"]
        errors = {"mse": mean, "mse_low": mean + std, "mse_high": mean - std}
        parts.append(table[["step", "n"]].assign(split=split, **{key: 10 ** (-v / 10) for key, v in errors.items()}))
    return pd.concat(parts)


def _times(paths: Sequence[str]) -> pd.DataFrame:
    table = _over_seeds([metrics(path, "eval/psnr") for path in paths], ["value", "time_s"])
    return table.drop(columns="time_s_std").rename(columns={"value": "psnr", "value_std": "psnr_std"})


def _binned(logged: Sequence[pd.DataFrame]) -> list[pd.DataFrame]:
    """Each seed's mean value over up to `BINS` spans of steps, which are the same for all seeds."""
    steps = np.unique(np.concatenate([rows["step"] for rows in logged]))
    ends = steps[::-1][:: -(-len(steps) // BINS)][::-1]
    binned = []
    for rows in logged:
        end = ends[np.searchsorted(ends, rows["step"])]
        binned.append(rows.assign(step=end).groupby("step", as_index=False).agg({"time_s": "last", "value": "mean"}))
    return binned


def _over_seeds(logged: Sequence[pd.DataFrame], columns: Sequence[str]) -> pd.DataFrame:
    """Mean and standard deviation of the columns, at the steps that every seed reached; a step's last row counts."""
    rows = pd.concat([own.drop_duplicates("step", keep="last") for own in logged])
    groups = rows[rows.groupby("step")["step"].transform("size") == len(logged)].groupby("step")
    table = pd.DataFrame({"n": groups.size()})
    for column in columns:
        table[column], table[f"{column}_std"] = groups[column].mean(), groups[column].std()
    return table.reset_index()


def _panels(
    frame: pd.DataFrame,
    curves: pd.DataFrame,
    most: int,
    key: str,
    draw: Callable[..., None],
    spread: str,
    *,
    sharey: bool = False,
) -> tuple[Figure, np.ndarray, str]:
    """A panel per scene, in which `draw` draws each configuration in a look of its own; the figure's last footnote."""
    table, notes = _best(frame, most, key)
    figure, axes = style.panels(table["scene_name"].nunique(), 2.6, sharey=sharey)
    fields = dict(zip(table["name"], table["field"], strict=True))
    looks = dict(zip(fields, style.looks(fields.values()), strict=True))
    for ax, (scene, shown) in zip(axes, curves.groupby("scene_name"), strict=True):
        for name, curve in shown.groupby("name", sort=False):
            draw(ax, name, curve, **looks[name])
        ax.set_title(scene)
    style.legend(figure)
    return figure, axes, f"{points.seeds(table, spread)}; {notes}".removesuffix("; ")
