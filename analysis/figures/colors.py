"""Hue, saturation and value of truth, classical and quantum renderings."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from .. import hsv, style
from ..selection import refuse_scenes, select
from . import points

EDGES = {
    "hue": np.linspace(0, 1, 61),
    "saturation": (np.arange(0, 257, 4) - 0.5) / 255,
    "value": (np.arange(0, 257, 4) - 0.5) / 255,
}
"""Bins: 6 degrees of hue; four 8-bit levels of the others, so that each bin holds equally many levels."""
_COLORS = {"classical": style.FIELDS["classical"][0], "quantum": style.FIELDS["qcolor"][0]}


def chosen(frame: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """The finished runs of the classical and of the quantum configuration of highest PSNR.

    Raises:
        ValueError: one of the kinds has no run, or there are several scenes.
    """
    runs = select(frame).runs
    refuse_scenes(runs, [])
    kinds = runs["field"].map(points.kind)
    result = {}
    for kind in ("classical", "quantum"):
        own = runs[kinds == kind]
        if own.empty:
            raise ValueError(f"no finished {kind} run to compare; fields: {', '.join(sorted(runs['field'].unique()))}")
        result[kind] = own.loc[list(points.points(own, ["psnr"]).iloc[0]["runs"])]
    return result


def hsv_histograms(samples: pd.DataFrame) -> pd.DataFrame:
    """Columns left, right, density (integral 1), density_std (over seeds; NaN for one), channel, source, n (seeds)."""
    tables = []
    for channel, edges in EDGES.items():
        for source, own in samples.groupby("source", observed=True):
            each = [
                np.histogram(part[channel].dropna(), edges, density=True)[0]
                for _, part in own.groupby(own["seed"].fillna(-1))
            ]
            std = np.std(each, axis=0, ddof=1) if len(each) > 1 else np.full(len(edges) - 1, np.nan)
            table = pd.DataFrame({"left": edges[:-1], "right": edges[1:], "density": np.mean(each, axis=0)})
            tables.append(table.assign(density_std=std, channel=channel, source=str(source), n=len(each)))
    return pd.concat(tables, ignore_index=True)


@style.styled
def hsv_study(frame: pd.DataFrame) -> Figure:
    """Distributions of hue, saturation and value: truth, and the best classical and quantum configuration."""
    runs = chosen(frame)
    samples = hsv.samples(runs)
    histograms = hsv_histograms(samples)
    figure = style.new(style.PAGE, 2.4)
    colors = {"truth": style.ink(), **_COLORS}
    for ax, channel in zip(figure.subplots(1, 3), hsv.CHANNELS, strict=True):
        unit = 360 if channel == "hue" else 1
        for source, dashes in zip(hsv.SOURCES, ("-", "-.", "--"), strict=True):
            curve = histograms[(histograms["channel"] == channel) & (histograms["source"] == source)]
            middle = (curve["left"] + curve["right"]) / 2 * unit
            density, spread = curve["density"] / unit, curve["density_std"] / unit
            ax.plot(middle, density, dashes, color=colors[source], label=source)
            ax.fill_between(middle, density - spread, density + spread, color=colors[source], alpha=0.2, lw=0)
        ax.set(xlim=(0, unit), ylim=(0, None))
        ax.set_xlabel("hue, degrees" if channel == "hue" else f"{channel}, of 1")
        ax.set_ylabel("density per degree" if channel == "hue" else "density")
    figure.axes[0].xaxis.set_major_locator(MultipleLocator(90))
    style.legend(figure)
    style.footnote(
        figure,
        *(f"{kind}: {_described(own)}" for kind, own in runs.items()),
        points.notation([" ".join(map(_described, runs.values()))]),
        "bands: ± standard deviation over seeds" if histograms["n"].max() > 1 else "n = 1 seed: no bands",
        "grey pixels have no hue: "
        + ", ".join(f"{source} {share:.0%}" for source, share in hsv.greys(samples).items()),
        select(frame).note,
    )
    return figure


def _described(runs: pd.DataFrame) -> str:
    first = runs.iloc[0]
    return f"{first['field']}, density {first['density']}, colour {first['color']}, n = {len(runs)}"
