"""Hue, saturation and value of truth, classical and quantum renderings."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from qnerf.records.filters import require

from .. import circular, hsv, style
from ..selection import select
from . import points

EDGES = {
    "hue": np.linspace(0, 1, 61),
    "saturation": (np.arange(0, 257, 4) - 0.5) / 255,
    "value": (np.arange(0, 257, 4) - 0.5) / 255,
}
"""Bins: 6 degrees of hue; four 8-bit levels, so that no bin catches more levels than another."""
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
_COLORS = {"classical": style.FIELDS["classical"][0], "quantum": style.FIELDS["qcolor"][0]}


def chosen(
    frame: pd.DataFrame, classical: Mapping[str, object] | None = None, quantum: Mapping[str, object] | None = None
) -> dict[str, pd.DataFrame]:
    """The finished runs of one classical and one quantum configuration: by columns and values, else the best ones.

    ValueError where there is none of a kind, or several scenes.
    """
    runs = select(frame).runs
    if runs["scene_name"].nunique() > 1:
        raise ValueError(f"{runs['scene_name'].nunique()} scenes ({', '.join(points.scenes(runs))}): filter on one")
    kinds = runs["field"].map(points.kind)
    found = {}
    for kind, conditions in (("classical", classical), ("quantum", quantum)):
        own = runs[kinds == kind]
        if own.empty:
            raise ValueError(f"no finished {kind} run to compare; fields: {', '.join(sorted(runs['field'].unique()))}")
        if conditions is not None:
            found[kind] = require(own, conditions)
        else:
            found[kind] = own.loc[list(points.points(own, ["psnr"]).iloc[0]["runs"])]
    return found


def hsv_samples(runs: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """`hsv.samples` of the `chosen` runs."""
    fields = {kind: {"field": own["field"].iloc[0]} for kind, own in runs.items()}
    return hsv.samples(pd.concat(runs.values()), **fields)


def hsv_histograms(samples: pd.DataFrame) -> pd.DataFrame:
    """Columns channel, source, left, right, density (integral 1), density_std (over seeds; NaN for one), n."""
    rows = []
    for channel, edges in EDGES.items():
        for source, own in samples.groupby("source", observed=True):
            each = [
                np.histogram(part[channel].dropna(), edges, density=True)[0]
                for _, part in own.groupby(own["seed"].fillna(-1))
            ]
            std = np.std(each, axis=0, ddof=1) if len(each) > 1 else np.full(len(edges) - 1, np.nan)
            table = pd.DataFrame({"left": edges[:-1], "right": edges[1:], "density": np.mean(each, axis=0)})
            rows.append(table.assign(density_std=std, channel=channel, source=str(source), n=len(each)))
    return pd.concat(rows, ignore_index=True)


def hsv_boxes(samples: pd.DataFrame) -> pd.DataFrame:
    """Columns channel, source, `QUANTILES` and pixels, over all seeds together.

    Hue is unrolled about the truth's mean direction m: quantiles are of m + the signed shorter way from m, in turns,
    and may lie outside [0, 1].
    """
    truth = samples.loc[samples["source"] == "truth", "hue"].dropna().to_numpy()
    middle = circular.mean_direction(truth)
    rows = []
    for channel in hsv.CHANNELS:
        for source, own in samples.groupby("source", observed=True):
            values = own[channel].dropna().to_numpy()
            if channel == "hue":
                values = middle + circular.turn(middle, values)
            rows.append((channel, str(source), *np.quantile(values, QUANTILES), len(values)))
    return pd.DataFrame(rows, columns=["channel", "source", *QUANTILES, "pixels"])


@style.styled
def hsv_study(
    frame: pd.DataFrame, classical: Mapping[str, object] | None = None, quantum: Mapping[str, object] | None = None
) -> Figure:
    """Distributions (above) and box plots (below) of hue, saturation and value: truth, classical, quantum.

    classical, quantum: columns and values that choose the runs; without them, the best configuration of each kind.
    """
    runs = chosen(frame, classical, quantum)
    samples = hsv_samples(runs)
    histograms, boxes = hsv_histograms(samples), hsv_boxes(samples)
    figure = style.new(style.PAGE, 3.6)
    axes = figure.subplots(2, 3, height_ratios=[1.5, 1])
    colors = {"truth": style.ink(), **_COLORS}
    for top, bottom, channel in zip(*axes, hsv.CHANNELS, strict=True):
        unit = 360 if channel == "hue" else 1
        for source, dashes in zip(hsv.SOURCES, ("-", "-.", "--"), strict=True):
            curve = histograms[(histograms["channel"] == channel) & (histograms["source"] == source)]
            middle = (curve["left"] + curve["right"]) / 2 * unit
            density = curve["density"] / unit
            top.plot(middle, density, dashes, color=colors[source], label=source)
            if curve["n"].iloc[0] > 1:
                spread = curve["density_std"] / unit
                top.fill_between(middle, density - spread, density + spread, color=colors[source], alpha=0.2, lw=0)
        top.set(title="hue, degrees" if channel == "hue" else channel, xlim=(0, unit), ylim=(0, None))
        _boxes(bottom, boxes[boxes["channel"] == channel], unit, colors)
        if channel == "hue":
            top.set_xticks(range(0, 361, 90))
        else:
            bottom.set_xlim(0, 1)
    axes[0, 0].set_ylabel("density")
    axes[0, 0].legend()
    names = ", ".join(f"{kind}: {_described(own)}" for kind, own in runs.items())
    grey = hsv.greys(samples)
    left = ", ".join(f"{source} {share:.0%}" for source, share in grey.items())
    spreads = "bands: ± standard deviation over seeds" if histograms["n"].max() > 1 else "n = 1 seed: no bands"
    style.footnote(
        figure, names, spreads, "boxes: quartiles, whiskers 5 to 95 %, hue unrolled about the truth's mean",
        f"grey pixels have no hue: {left}", select(frame).note,
    )  # fmt: skip
    return figure


def _boxes(ax: Axes, boxes: pd.DataFrame, unit: float, colors: Mapping[str, str]) -> None:
    stats = [
        {
            "whislo": row[0.05],
            "q1": row[0.25],
            "med": row[0.5],
            "q3": row[0.75],
            "whishi": row[0.95],
            "label": row["source"],
        }
        for _, row in boxes.iterrows()
    ]
    for box in stats:
        box |= {key: value * unit for key, value in box.items() if key != "label"}
    drawn = ax.bxp(stats, orientation="horizontal", showfliers=False, patch_artist=True, widths=0.55)
    for patch, median, box in zip(drawn["boxes"], drawn["medians"], stats, strict=True):
        patch.set(facecolor=colors[box["label"]], alpha=0.35, edgecolor=colors[box["label"]])
        median.set(color=style.ink(), linewidth=1.2)
    for line in (*drawn["whiskers"], *drawn["caps"]):
        line.set(color=style.ink(), linewidth=0.6)
    ax.invert_yaxis()


def _described(runs: pd.DataFrame) -> str:
    first = runs.iloc[0]
    return f"{first['field']} {first['density']} {first['color']}, n = {len(runs)}"
