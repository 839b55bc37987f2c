"""Barren plateaus: how the gradients of random circuits vanish with wires and depth."""

from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from qnerf.config.folders import BENCHMARKS

from .. import style

BENCHMARK = BENCHMARKS / "plateaus.parquet"


def plateau_points(results: str | Path | pd.DataFrame = BENCHMARK) -> pd.DataFrame:
    """Rows of the benchmark: init, S, wires, circuits, variance of d<Z_0>/d theta, and its standard error.

    ValueError where there is no benchmark.
    """
    if not isinstance(results, pd.DataFrame):
        if not Path(results).is_file():
            raise ValueError(f"{results}: no benchmark; `python -m benchmarks.plateaus` writes it")
        results = pd.read_parquet(results)
    return results[["init", "S", "wires", "circuits", "variance", "error"]].sort_values(["init", "S", "wires"])


@style.styled
def barren_plateaus(results: str | Path | pd.DataFrame = BENCHMARK) -> Figure:
    """Variance of a gradient against wires, one line a number of re-uploadings S, one panel a way to start."""
    table = plateau_points(results)
    figure = style.new(style.PAGE, 2.8)
    axes = figure.subplots(1, table["init"].nunique(), sharex=True, sharey=True, squeeze=False)[0]
    depths = sorted(table["S"].unique())
    for ax, (init, shown) in zip(axes, table.groupby("init"), strict=True):
        for spectral, line in shown.groupby("S"):
            look = style.series(depths.index(spectral))
            ax.errorbar(line["wires"], line["variance"], line["error"], **look, elinewidth=0.6, label=f"S = {spectral}")
        ax.set(title=f"init={init}", xlabel="wires", yscale="log")
    axes[0].set_ylabel("variance of d<Z$_0$>/dθ")
    style.legend(figure, columns=len(depths))
    circuits = table["circuits"].unique()
    style.footnote(
        figure,
        f"qiren, {'-'.join(map(str, sorted(circuits)))} random circuits a point; bars: standard error; "
        "θ: one RY of wire 0 in the middle block",
    )
    return figure
