"""Where each sampling strategy places its samples along a ray."""

from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from .. import style
from .probed import probed


def ray_samples(run: str | Path, ray: int = 0) -> pd.DataFrame:
    """One ray of a run's rays.parquet: its columns, and `row`, which names strategy and level.

    The strategies that the run is compared with come first. Raises ValueError for a ray that does not exist, or a run
    without the probe.
    """
    table = probed(run, "rays")
    pixels = table[["pixel_x", "pixel_y"]].drop_duplicates()
    if not 0 <= ray < len(pixels):
        raise ValueError(f"ray {ray}: {run} has rays 0 to {len(pixels) - 1}")
    samples = table.merge(pixels.iloc[[ray]])
    single_level = samples["level"].eq("final") & ~samples["own"]
    row = samples["strategy"].where(single_level, samples["strategy"] + ": " + samples["level"])
    return samples.assign(row=row).sort_values("own", kind="stable", ignore_index=True)


@style.styled
def sampling_strategies(run: str | Path, ray: int = 0) -> Figure:
    """Intervals, weights and transmittance of each strategy along one ray of a held-out view."""
    table = ray_samples(run, ray)
    rows = list(table.groupby("row", sort=False))
    figure = style.new(style.PAGE, 0.6 + 0.62 * len(rows))
    axes = figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
    for ax, (name, level) in zip(axes, rows, strict=True):
        color = style.PALETTE[0] if level["own"].iloc[0] else style.PALETTE[1]
        edges = [*level["start"], level["end"].iloc[-1]]
        peak = level["weight"].max() or 1
        ax.stairs(level["weight"] / peak, edges, fill=True, color=color, alpha=0.45)
        ax.stairs(level["transmittance"], edges, color=style.ink(), lw=0.8, baseline=None)
        ax.vlines((level["start"] + level["end"]) / 2, -0.32, -0.08, color=color, lw=0.6)
        if level["depth"].notna().all():
            ax.axvline(level["depth"].iloc[0], color=style.ink(), lw=0.8, ls=":")
        ax.set(ylim=(-0.4, 1.08), yticks=[0, 1], xscale="log")
        ax.set_ylabel(f"{name}\n{len(level)} samples", rotation=0, ha="right", va="center")
        ax.grid(False)
    axes[-1].set_xlabel("distance along the ray, world units")
    first = table.iloc[0]
    style.footnote(
        figure,
        "ticks: midpoints of the intervals",
        "filled: weight, scaled to a maximum of 1",
        "line: transmittance",
        "dotted: true depth" if table["depth"].notna().all() else "",
        f"{Path(run).name}, {first['image']}, pixel ({first['pixel_x']}, {first['pixel_y']})",
    )
    return figure
