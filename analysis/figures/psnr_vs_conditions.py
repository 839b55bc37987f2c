"""Trained circuits as hardware would measure them: finite shots, noisy gates."""

import pandas as pd
from matplotlib.figure import Figure

from qnerf.metrics import metric_of

from .. import style
from ..condition_means import FILE, means
from ..selection import select
from . import points
from .probed import having, probed


def hardware_points(frame: pd.DataFrame) -> pd.DataFrame:
    """PSNR under each measured condition, over the seeds of each configuration.

    Columns scene_name, name, field, shots (0: exact), noise ("none"), p, psnr (dB, mean over the views, then over the
    seeds), psnr_std (over seeds; NaN for one), n, and seeds: how many of the configuration were measured at all. Only
    views that a run has under each of its conditions count.
    """
    runs = having(select(frame).runs, FILE)
    table = points.points(runs, ["psnr"])
    parts = []
    for _, row in table.iterrows():
        each = pd.concat([means(probed(runs["path"][index], FILE)) for index in row["runs"]])
        groups = each.groupby(["shots", "noise", "p"])["psnr"]
        found = pd.DataFrame({"psnr": groups.mean(), "psnr_std": groups.std(), "n": groups.size()}).reset_index()
        parts.append(found.assign(scene_name=row["scene_name"], name=row["name"], field=row["field"], seeds=row["n"]))
    return pd.concat(parts, ignore_index=True)


@style.styled
def psnr_vs_shots(frame: pd.DataFrame) -> Figure:
    """PSNR against the shots of each circuit, the exact rendering dashed; one panel a scene."""
    return _draw(frame, "shots")


@style.styled
def psnr_vs_noise(frame: pd.DataFrame) -> Figure:
    """PSNR against the probability of a gate error, the noiseless rendering dashed; one panel a scene and channel."""
    return _draw(frame, "p")


def _draw(frame: pd.DataFrame, x: str) -> Figure:
    table = hardware_points(frame)
    noisy = table["noise"] != "none"
    asked = ~noisy & (table["shots"] > 0) if x == "shots" else noisy & (table["shots"] == 0)
    shown = table[asked & (table["n"] == table["seeds"])]
    if shown.empty:
        how = "shots=100,1000" if x == "shots" else "noise=depolarizing p=0.001,0.01"
        raise ValueError(
            f"no condition of this kind was measured for every seed of a configuration; `qnerf evaluate RUN {how}`"
        )
    panels = list(shown.groupby(["scene_name", "noise"]))
    figure = style.new(style.COLUMN if len(panels) == 1 else style.PAGE, 2.6)
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for ax, ((scene, noise), lines) in zip(axes, panels, strict=True):
        for number, (name, line) in enumerate(lines.groupby("name", sort=False)):
            look = style.series(number)
            ax.errorbar(line[x], line["psnr"], line["psnr_std"], label=name, **look)
            exact = ~noisy & (table["shots"] == 0) & (table["scene_name"] == scene) & (table["name"] == name)
            ax.axhline(table.loc[exact, "psnr"].item(), color=look["color"], ls="--", lw=0.8)
        ax.set(title=str(scene) if x == "shots" else f"{scene}: {noise}", xscale="log")
        ax.set_xlabel("shots of each circuit" if x == "shots" else "probability of an error, each gate")
        ax.legend()
    axes[0].set_ylabel(metric_of("psnr").heading)
    fewer = asked.sum() - len(shown)
    part = f"not drawn: {fewer} conditions that not every measured seed has" if fewer else ""
    style.footnote(figure, "dashed: exact", points.seeds(shown), part, select(frame).note)
    return figure
