"""Numerical error against speed: each part of the pipeline on ordinary and hard inputs, in float32 and float64."""

import pandas as pd
from matplotlib.figure import Figure

from .. import style
from . import benchmarks

FLOOR = 1e-17
"""Results that equal the reference to the last bit are drawn at this error."""


def accuracy_points(results: benchmarks.Results = None) -> pd.DataFrame:
    """The benchmark accuracy, a row per case, variant and dtype: part, case, variant, dtype, ms, error, bound.

    ms: median time of a forward and backward pass. error: against float64, relative to the largest value; the larger
    one of output and gradients. bound: the larger of their bounds, NaN if none is promised. The float64 reference
    itself is left out.
    """
    results = benchmarks.read("accuracy", results)
    table = results[["part", "case", "variant", "dtype", "ms"]].assign(
        error=results[["error", "gradient_error"]].max(axis=1),
        bound=results[["bound", "gradient_bound"]].max(axis=1).where(results["bounded"]),
    )
    return table[(table["variant"] != "plain") | (table["dtype"] != "float64")].reset_index(drop=True)


@style.styled
def accuracy_vs_speed(results: benchmarks.Results = None) -> Figure:
    """Error against time, a panel per part: a colour per variant, filled for float32, the largest bound dashed."""
    table = accuracy_points(results)
    variants = list(dict.fromkeys(table["variant"]))
    parts = list(table.groupby("part", sort=False))
    figure, axes = style.panels(len(parts), 1.8, sharex=True, sharey=True)
    for ax, (part, shown) in zip(axes, parts, strict=True):
        for (variant, dtype), group in shown.groupby(["variant", "dtype"], sort=False):
            look = style.series(variants.index(variant))
            face = look["color"] if dtype == "float32" else style.paper()
            error = group["error"].clip(lower=FLOOR)
            ax.plot(group["ms"], error, ls="", mfc=face, mew=0.8, label=f"{variant}, {dtype}", **look)
        bound = shown.loc[shown["dtype"] == "float32", "bound"].max()
        ax.axhline(bound, color=style.ink(), ls="--", lw=0.7, alpha=0.6)
        ax.set(title=part, xlabel="forward + backward, ms", xscale="log", yscale="log")
        style.plain_ticks(ax)
        ax.tick_params(labelbottom=True)
    for ax in axes[::3]:
        ax.set_ylabel("relative error")
    style.legend(figure)
    style.footnote(
        figure,
        "a point is a case; error: largest difference from float64 in output and gradients, relative to the largest "
        "value",
        f"dashed: largest bound in float32; results equal to the last bit are drawn at {FLOOR:g}",
    )
    return figure
