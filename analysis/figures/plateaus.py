"""Barren plateaus: how the gradients of random circuits vanish with wires and depth."""

import pandas as pd
from matplotlib.figure import Figure

from .. import style
from . import benchmarks


def plateau_points(results: benchmarks.Results = None) -> pd.DataFrame:
    """The benchmark plateaus: init, S, wires, circuits, variance of d<Z_0>/d theta, and error, its standard error."""
    table = benchmarks.read("plateaus", results)
    return table[["init", "S", "wires", "circuits", "variance", "error"]].sort_values(["init", "S", "wires"])


@style.styled
def barren_plateaus(results: benchmarks.Results = None) -> Figure:
    """Variance of a gradient against wires, a line per number of re-uploadings S, a panel per `qiren.init`."""
    table = plateau_points(results)
    figure = style.new(style.PAGE, 2.8)
    axes = figure.subplots(1, table["init"].nunique(), sharex=True, sharey=True, squeeze=False)[0]
    depths = sorted(table["S"].unique())
    for ax, (init, shown) in zip(axes, table.groupby("init"), strict=True):
        for spectral, line in shown.groupby("S"):
            look = style.series(depths.index(spectral))
            ax.errorbar(line["wires"], line["variance"], line["error"], **look, elinewidth=0.6, label=f"S = {spectral}")
        ax.set(title=f"init = {init}", xlabel="wires", yscale="log")
    axes[0].set_ylabel("variance of d⟨Z₀⟩/dθ, rad⁻²")
    style.legend(figure)
    circuits = "-".join(map(str, sorted(table["circuits"].unique())))
    style.footnote(
        figure,
        f"qiren, {circuits} random circuits per point; bars: standard error; θ: one RY of wire 0 in the middle block",
    )
    return figure
