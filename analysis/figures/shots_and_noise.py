"""PSNR of trained circuits on hardware: with a finite number of shots, or with gate errors."""

import pandas as pd
from matplotlib.figure import Figure

from qnerf.metrics import metric_of

from .. import style
from ..selection import select
from ..tables.resources import HARDWARE, means
from . import points
from .probed import having, probed


def hardware_points(frame: pd.DataFrame) -> pd.DataFrame:
    """PSNR under each measured condition, over the seeds of each configuration.

    Columns shots, noise and p as of `means`, psnr (dB, mean over views, then over seeds), psnr_std (over seeds; NaN for
    one), n (seeds measured under this condition), scene_name, name, field, seeds (measured under any condition).
    """
    runs = having(select(frame).runs, HARDWARE)
    parts = []
    for _, row in points.points(runs, ["psnr"]).iterrows():
        measured = pd.concat([means(probed(runs["path"][index], HARDWARE)) for index in row["runs"]])
        groups = measured.groupby(["shots", "noise", "p"])["psnr"]
        table = pd.DataFrame({"psnr": groups.mean(), "psnr_std": groups.std(), "n": groups.size()}).reset_index()
        parts.append(table.assign(**row[["scene_name", "name", "field"]], seeds=row["n"]))
    return pd.concat(parts, ignore_index=True)


@style.styled
def psnr_vs_shots(frame: pd.DataFrame) -> Figure:
    """PSNR against the shots per circuit, a panel per scene; the exact rendering is dashed."""
    return _draw(frame, "shots")


@style.styled
def psnr_vs_noise(frame: pd.DataFrame) -> Figure:
    """PSNR against the probability of a gate error, a panel per scene and noise channel; without noise is dashed."""
    return _draw(frame, "p")


def _draw(frame: pd.DataFrame, x: str) -> Figure:
    table = hardware_points(frame)
    noisy = table["noise"] != "none"
    of_kind = ~noisy & (table["shots"] > 0) if x == "shots" else (table["p"] > 0) & (table["shots"] == 0)
    shown = table[of_kind & (table["n"] == table["seeds"])]
    if shown.empty:
        options = "shots=100,1000" if x == "shots" else "noise=depolarizing p=0.001,0.01"
        raise ValueError(
            f"no condition of this kind was measured for every seed of a configuration; `qnerf probe RUN {options}`"
        )
    panels = list(shown.groupby(["scene_name", "noise"]))
    fields = dict(zip(shown["name"], shown["field"], strict=True))
    looks = dict(zip(fields, style.looks(fields.values()), strict=True))
    figure, axes = style.panels(len(panels), 2.4, sharey=True)
    for ax, ((scene, noise), lines) in zip(axes, panels, strict=True):
        for name, line in lines.groupby("name", sort=False):
            look = looks[name]
            ax.errorbar(line[x], line["psnr"], line["psnr_std"], label=name, **look)
            exact = ~noisy & (table["shots"] == 0) & (table["scene_name"] == scene) & (table["name"] == name)
            ax.axhline(table.loc[exact, "psnr"].item(), color=look["color"], ls="--", lw=0.8)
        ax.set(title=str(scene) if x == "shots" else f"{scene}: {noise}", xscale="log")
        ax.set_xlabel("shots per circuit" if x == "shots" else "error probability of each gate")
        style.plain_ticks(ax)
    style.legend(figure)
    axes[0].set_ylabel(metric_of("psnr").heading)
    partial = of_kind.sum() - len(shown)
    rest = f"not drawn: {partial} conditions that some measured seeds lack" if partial else ""
    style.footnote(figure, "dashed: exact", points.seeds(shown), rest, points.notation(fields), select(frame).note)
    return figure
