"""Numerical error against speed: every part and hard case in float32 and float64."""

from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from qnerf.config.folders import BENCHMARKS

from .. import style

BENCHMARK = BENCHMARKS / "accuracy.parquet"
LEAST = 1e-17
"""Where results that are equal to the last bit are drawn."""


def accuracy_points(results: str | Path | pd.DataFrame = BENCHMARK) -> pd.DataFrame:
    """One row a case, variant and dtype of the accuracy benchmark: part, case, variant, dtype, ms, error, bound.

    `ms`: median of a forward and backward pass; `error`: the larger of the forward and the gradients' error against
    float64, relative to the largest value; `bound`: the larger of theirs, NaN where none is promised. The reference
    itself, whose error is 0 by definition, is left out. ValueError where there is no benchmark.
    """
    if not isinstance(results, pd.DataFrame):
        if not Path(results).is_file():
            raise ValueError(f"{results}: no benchmark; `python -m benchmarks.accuracy` writes it")
        results = pd.read_parquet(results)
    table = results[["part", "case", "variant", "dtype", "ms"]].assign(
        error=results[["error", "gradient_error"]].max(axis=1),
        bound=results[["bound", "gradient_bound"]].max(axis=1).where(results["bounded"]),
    )
    return table[(table["variant"] != "plain") | (table["dtype"] != "float64")].reset_index(drop=True)


@style.styled
def accuracy_vs_speed(results: str | Path | pd.DataFrame = BENCHMARK) -> Figure:
    """Error against time, one panel a part: colour for the variant, filled for float32, the largest bound dashed."""
    table = accuracy_points(results)
    variants = list(dict.fromkeys(table["variant"]))
    parts = list(table.groupby("part", sort=False))
    columns = min(4, len(parts))
    rows = -(-len(parts) // columns)
    figure = style.new(style.PAGE, 0.5 + 1.6 * rows)
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    for ax, (part, shown) in zip(axes, parts, strict=False):
        for (variant, dtype), own in shown.groupby(["variant", "dtype"], sort=False):
            look = style.series(variants.index(variant))
            face = look["color"] if dtype == "float32" else "none"
            ax.plot(own["ms"], own["error"].clip(lower=LEAST), ls="", mfc=face, label=f"{variant}, {dtype}", **look)
        bound = shown.loc[shown["dtype"] == "float32", "bound"].max()
        ax.axhline(bound, color=style.ink(), ls="--", lw=0.7, alpha=0.6)
        ax.set(title=part, xscale="log", yscale="log")
        style.plain_ticks(ax)
    for ax in axes[len(parts) :]:
        ax.set_axis_off()
    for ax in axes[: len(parts)][-columns:]:
        ax.set_xlabel("forward + backward, ms")
        ax.tick_params(labelbottom=True)
    for ax in axes[::columns]:
        ax.set_ylabel("relative error")
    style.legend(figure, columns=4)
    style.footnote(
        figure,
        "each point a case; error: largest difference from float64 over values and gradients, relative to the largest",
        f"dashed: largest bound in float32; drawn at {LEAST:g}: equal to the last bit",
    )
    return figure
