"""What happens during training: losses, and errors in octaves of frequency."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from qnerf.metrics import OCTAVES

from .. import style
from ..load import metrics
from ..selection import main_metric, select
from . import points

MOST = 6  # configurations in one panel
BINS = 50  # points of a training curve
LEAST = 1e-4  # error in an octave that is drawn


def loss_points(frame: pd.DataFrame, most: int = MOST) -> pd.DataFrame:
    """Mean squared colour error against steps, over the seeds of the `most` best configurations of each scene.

    The training error is averaged over up to `BINS` equal spans of steps; the error of held-out views is
    10^(-PSNR / 10). Columns step (the last of its span), n, mse (geometric mean over seeds), mse_low and mse_high (one
    standard deviation of its logarithm; NaN for one seed), split (train | eval), scene_name, name.
    """
    table, _ = _best(frame, most)
    curves = [_losses(frame["path"][row["runs"]]).assign(**row[["scene_name", "name"]]) for _, row in table.iterrows()]
    return pd.concat(curves, ignore_index=True)


@style.styled
def loss_curves(frame: pd.DataFrame, most: int = MOST) -> Figure:
    """Colour error of training (solid) and of held-out views (dashed) against steps, a panel per scene."""
    curves, (table, notes) = loss_points(frame, most), _best(frame, most)
    figure, axes = style.panels(table["scene_name"].nunique(), 2.6, sharey=True)
    fields = dict(zip(table["name"], table["field"], strict=True))
    looks = dict(zip(fields, style.looks(fields.values()), strict=True))
    for ax, (scene, shown) in zip(axes, curves.groupby("scene_name"), strict=True):
        for (name, split), part in shown.groupby(["name", "split"], sort=False):
            color, marker = looks[name]["color"], looks[name]["marker"]
            look: dict[str, Any] = {"ls": "--", "marker": marker, "label": name} if split == "eval" else {}
            ax.plot(part["step"], part["mse"], color=color, ms=3.5, **look)
            ax.fill_between(part["step"], part["mse_low"], part["mse_high"], color=color, alpha=0.18, lw=0)
        ax.set(title=scene, xlabel="optimisation step", yscale="log")
        ax.xaxis.set_major_locator(MaxNLocator(4))
        ax.xaxis.set_major_formatter(style.PLAIN)
    axes[0].set_ylabel("mean squared colour error")
    style.legend(figure)
    lines = "solid: training; dashed: held out, 10^(-PSNR/10), of train.eval_views of the held-out views"
    style.footnote(figure, lines, points.seeds(table, "bands"), notes)
    return figure


def octave_points(frame: pd.DataFrame, most: int = MOST) -> pd.DataFrame:
    """Error in each octave of frequency against steps and CPU seconds, of the `most` best configurations of each scene.

    Columns step, cpu_s (step times the mean CPU time of a step), n, error (geometric mean over seeds), error_low and
    error_high (one standard deviation of its logarithm; NaN for one seed), octave, scene_name, name.
    """
    return _octave_curves(frame, _best(frame, most, *_octaves(frame))[0])


@style.styled
def octave_errors(frame: pd.DataFrame, most: int = MOST) -> Figure:
    """Error in each octave, a panel each, against steps and, below, against CPU seconds; a line a configuration."""
    table, notes = _best(frame, most, *_octaves(frame))
    curves = _octave_curves(frame, table)
    octaves, names, scenes = sorted(curves["octave"].unique()), sorted(table["name"].unique()), points.scenes(table)
    looks = [{"color": color, "ls": dash} for dash in ("-", "--") for color in style.PALETTE]
    figure = style.new(style.PAGE, 3.0 * len(scenes))
    axes = figure.subplots(2 * len(scenes), len(octaves), sharey=True, sharex="row", squeeze=False)
    kinds = [(scene, *x) for scene in scenes for x in (("step", "step"), ("cpu_s", "CPU s"))]
    for line, (scene, x, heading) in zip(axes, kinds, strict=True):
        for ax, octave in zip(line, octaves, strict=True):
            shown = curves[(curves["scene_name"] == scene) & (curves["octave"] == octave)]
            for name, part in shown.groupby("name"):
                look = looks[names.index(name) % len(looks)]
                ax.plot(part[x], part["error"], label=name, **look)
                ax.fill_between(part[x], part["error_low"], part["error_high"], color=look["color"], alpha=0.18, lw=0)
            low = f"{2 ** (octave - 1)}" if octave > 1 else "0"  # the lowest octave has all slow waves
            ax.set(title=f"{low} to {2**octave} cycles", xlabel=heading, xscale="log", yscale="log")
            ax.xaxis.set_major_formatter(style.PLAIN)
            ax.xaxis.set_minor_formatter(NullFormatter())
            ax.yaxis.set_major_locator(LogLocator(100))
        line[0].set_ylabel(f"{scene}: error")
    axes[0, 0].set_ylim(bottom=max(LEAST, curves["error"].min() / 2))
    style.legend(figure)
    what = "error: its energy over the truth's, in an octave of cycles a side"
    style.footnote(figure, what, points.seeds(table, "bands"), notes)
    return figure


def _octave_curves(frame: pd.DataFrame, table: pd.DataFrame) -> pd.DataFrame:
    curves = []
    for _, row in table.iterrows():
        seconds = frame["step_cpu_ms"][row["runs"]].mean() / 1000
        logged = [metrics(path) for path in frame["path"][row["runs"]]]
        for rows in logged:
            rows["value"] = np.log10(rows["value"].clip(lower=1e-12))
        for octave, key in enumerate(OCTAVES, 1):
            curve = _over_seeds([rows[rows["key"] == f"eval/{key}"] for rows in logged])
            mean, std = curve["value"], curve["value_std"]
            errors = {"error": mean, "error_low": mean - std, "error_high": mean + std}
            curve = curve[["step", "n"]].assign(**{name: 10**value for name, value in errors.items()})
            curves.append(curve.assign(cpu_s=curve["step"] * seconds, octave=octave, **row[["scene_name", "name"]]))
    return pd.concat(curves, ignore_index=True)


def _octaves(frame: pd.DataFrame) -> tuple[str, str, Sequence[str]]:
    return f"eval/{OCTAVES[0]}", main_metric(frame), ["field"]


def _best(
    frame: pd.DataFrame, most: int, logged: str = "train/mse", metric: str = "psnr", never: Sequence[str] = ()
) -> tuple[pd.DataFrame, str]:
    """`points.best` of the runs that have logged a key, readably, and a note on names and on what is left out.

    ValueError with the reason if none has.
    """
    selection = select(frame, metric)
    problems: dict[str, str] = {}
    for path in selection.runs["path"]:
        try:
            if metrics(path, logged).empty:
                problems[path] = f"{path}: has not logged {logged}"
        except ValueError as error:
            problems[path] = str(error)
    if len(problems) == len(selection.runs):
        raise ValueError(next(iter(problems.values())))
    table, rest = points.best(selection.runs[~selection.runs["path"].isin(list(problems))], [metric], most, never)
    damaged = f"left out: {len(problems)} with missing or damaged metrics" if problems else ""
    return table, "; ".join(filter(None, [rest, damaged, points.notation(table["name"]), selection.note]))


def _losses(paths: Sequence[str]) -> pd.DataFrame:
    training = _binned([metrics(path, "train/mse") for path in paths])
    for logged in training:
        logged["value"] = -10 * np.log10(logged["value"])
    parts = []
    for split, decibels in (("train", training), ("eval", [metrics(path, "eval/psnr") for path in paths])):
        table = _over_seeds(decibels)
        mean, std = table["value"], table["value_std"]
        errors = {"mse": mean, "mse_low": mean + std, "mse_high": mean - std}
        parts.append(table[["step", "n"]].assign(split=split, **{key: 10 ** (-v / 10) for key, v in errors.items()}))
    return pd.concat(parts)


def _binned(logged: Sequence[pd.DataFrame]) -> list[pd.DataFrame]:
    """Each seed's mean value over up to `BINS` spans of steps, which are the same for all seeds."""
    steps = np.unique(np.concatenate([rows["step"] for rows in logged]))
    ends = steps[::-1][:: -(-len(steps) // BINS)][::-1]
    binned = []
    for rows in logged:
        end = ends[np.searchsorted(ends, rows["step"])]
        binned.append(rows.assign(step=end).groupby("step", as_index=False).agg({"time_s": "last", "value": "mean"}))
    return binned


def _over_seeds(logged: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Mean and standard deviation of the value, at the steps that every seed reached; a step's last row counts."""
    rows = pd.concat([own.drop_duplicates("step", keep="last") for own in logged])
    groups = rows[rows.groupby("step")["step"].transform("size") == len(logged)].groupby("step")
    table = pd.DataFrame({"n": groups.size(), "value": groups["value"].mean(), "value_std": groups["value"].std()})
    return table.reset_index()
