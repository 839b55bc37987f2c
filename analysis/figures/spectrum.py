"""Which frequencies a trained circuit uses."""

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from .. import style
from .probed import probed

MIN_SHARE = 1e-4
"""Smaller shares are left blank."""


def spectrum_points(run: str | Path) -> pd.DataFrame:
    """A run's spectrum.parquet with `share`: the part of the output's variance over uniform angles, in [0, 1].

    The shares of one angle sum to 1. Its share at frequency 0 is the variance that does not depend on this angle.
    """
    table = probed(run, "spectrum")
    varying = table["power"] - table["mean"] ** 2 * (table["frequency"] == 0)
    return table.assign(share=varying / table["variance"])


@style.styled
def fourier_spectrum(run: str | Path) -> Figure:
    """Share of each output's variance at each frequency of each angle: a row per circuit, a column per frequency."""
    table = spectrum_points(run)
    used = table[table["frequency"] > 0]
    circuits = list(used.groupby(["head", "circuit"]))
    frequencies = sorted(used["frequency"].unique())
    figure = style.new(min(style.PAGE, 1.4 + 1.6 * (len(frequencies) + 1)), 0.6 + 1.6 * len(circuits))
    axes = figure.subplots(len(circuits), len(frequencies) + 1, squeeze=False)
    norm = LogNorm(MIN_SHARE, 1)
    for row, ((head, circuit), rows) in zip(axes, circuits, strict=True):
        wires, outputs = range(rows["wire"].max() + 1), sorted(rows["output"].unique())
        for ax, frequency in zip(row, frequencies, strict=False):
            grid = rows[rows["frequency"] == frequency].pivot(index="output", columns="wire", values="share")
            grid = grid.reindex(index=outputs, columns=wires)
            image = ax.imshow(grid.where(grid >= MIN_SHARE), norm=norm, cmap="viridis_r", aspect="equal")
            ax.set(xticks=list(wires)[::2], yticks=outputs[::2])
            ax.grid(False)
        row[0].set_ylabel(f"{style.HEADS.get(str(head), head)}, circuit {circuit}\noutput")
        _totals(row[-1], rows)
        row[-1].set_ylabel("share of the variance")
    for ax, frequency in zip(axes[0], frequencies, strict=False):
        ax.set_title(f"frequency\n{frequency:g} rad⁻¹")
    for ax in axes[-1, :-1]:
        ax.set_xlabel("angle (wire)")
    axes[-1, -1].set_xlabel("frequency, rad⁻¹")
    axes[0, -1].set_title("mean over angles\nand outputs")
    figure.colorbar(image, ax=axes[:, :-1], label="share of the output's variance", aspect=30, pad=0.02, extend="min")
    style.footnote(
        figure,
        _accuracy(table),
        f"variance over uniform angles; blank: less than {MIN_SHARE:.2%} or outside the light cone",
        "grey: variance that does not depend on the angle; bars of a circuit sum to 1",
        _spread(table),
        Path(run).name,
    )
    return figure


def _totals(ax: Axes, rows: pd.DataFrame) -> None:
    """Bars of the mean share at each frequency, and at 0 the rest: the variance that does not depend on the angle."""
    pairs = rows["output"].nunique() * (rows["wire"].max() + 1)
    mean = rows.groupby("frequency")["share"].sum() / pairs
    width = 0.6 * np.diff([0.0, *mean.index]).min()
    ax.bar(mean.index, mean, width=width, color=style.PALETTE[0])
    ax.bar(0, 1 - mean.sum(), width=width, color=style.PALETTE[-1])
    ax.set(xticks=[0, *mean.index], ylim=(0, 1))
    ax.grid(False, axis="x")


def _accuracy(table: pd.DataFrame) -> str:
    if (table["method"] == "exact").all():
        return "exact"
    relative = (table["standard_error"] / table["variance"]).max()
    return f"scrambled Sobol points, standard error of a share at most {relative:.1g}"


def _spread(table: pd.DataFrame) -> str:
    """How far the training samples move each angle, which tells how much of a period they cover."""
    std = table["angle_std"].dropna()
    if std.empty:
        return ""
    return f"the training samples' angles have standard deviations of {std.min():.2f} to {std.max():.2f} rad"
