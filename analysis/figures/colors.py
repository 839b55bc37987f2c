"""Hue, saturation and value of truth, classical and quantum renderings."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MultipleLocator

from qnerf.records.filters import require

from .. import hsv, style
from ..selection import select
from . import points

EDGES = {
    "hue": np.linspace(0, 1, 61),
    "saturation": (np.arange(0, 257, 4) - 0.5) / 255,
    "value": (np.arange(0, 257, 4) - 0.5) / 255,
}
"""Bins: 6 degrees of hue; four 8-bit levels of the others, so that each bin holds equally many levels."""
_COLORS = {"classical": style.FIELDS["classical"][0], "quantum": style.FIELDS["qcolor"][0]}


def chosen(
    frame: pd.DataFrame, classical: Mapping[str, object] | None = None, quantum: Mapping[str, object] | None = None
) -> dict[str, pd.DataFrame]:
    """The finished runs of one classical and one quantum configuration.

    classical, quantum: columns and values that choose the runs; None: the configuration of highest PSNR. Raises
    ValueError if one of the kinds has no run, or if there are several scenes.
    """
    runs = select(frame).runs
    if runs["scene_name"].nunique() > 1:
        raise ValueError(f"{runs['scene_name'].nunique()} scenes ({', '.join(points.scenes(runs))}): filter on one")
    kinds = runs["field"].map(points.kind)
    result = {}
    for kind, conditions in (("classical", classical), ("quantum", quantum)):
        own = runs[kinds == kind]
        if own.empty:
            raise ValueError(f"no finished {kind} run to compare; fields: {', '.join(sorted(runs['field'].unique()))}")
        if conditions is not None:
            result[kind] = require(own, conditions)
        else:
            result[kind] = own.loc[list(points.points(own, ["psnr"]).iloc[0]["runs"])]
    return result


def hsv_samples(runs: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """`hsv.samples` of the runs that `chosen` returns."""
    classical, quantum = ({"field": runs[kind]["field"].iloc[0]} for kind in ("classical", "quantum"))
    return hsv.samples(pd.concat(runs.values()), classical=classical, quantum=quantum)


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


def turn(center: float, hues: np.ndarray) -> np.ndarray:
    """The signed shorter way around the circle from `center` to each hue, turns in [-0.5, 0.5)."""
    return (hues - center + 0.5) % 1 - 0.5


def hue_center(samples: pd.DataFrame) -> float:
    """The truth's mean direction in turns, rounded so that the opposite side of the circle is an edge of a bin."""
    truth = samples.loc[samples["source"] == "truth", "hue"].dropna().to_numpy()
    bins = len(EDGES["hue"]) - 1
    mean = np.angle(np.exp(2j * np.pi * truth).sum()) / (2 * np.pi) % 1  # the direction of the sum of unit vectors
    return float(round(mean * bins) / bins)


@style.styled
def hsv_study(
    frame: pd.DataFrame, classical: Mapping[str, object] | None = None, quantum: Mapping[str, object] | None = None
) -> Figure:
    """Distributions of hue, saturation and value: truth, classical, quantum.

    classical, quantum: columns and values that choose the runs; None: the configuration of highest PSNR.
    """
    runs = chosen(frame, classical, quantum)
    samples = hsv_samples(runs)
    histograms, center = hsv_histograms(samples), hue_center(samples)
    figure = style.new(style.PAGE, 2.4)
    axes = figure.subplots(1, 3)
    colors = {"truth": style.ink(), **_COLORS}
    for ax, channel in zip(axes, hsv.CHANNELS, strict=True):
        unit = 360 if channel == "hue" else 1
        for source, dashes in zip(hsv.SOURCES, ("-", "-.", "--"), strict=True):
            curve = histograms[(histograms["channel"] == channel) & (histograms["source"] == source)]
            middle = (curve["left"] + curve["right"]) / 2
            if channel == "hue":
                curve = curve.assign(middle=center + turn(center, middle.to_numpy())).sort_values("middle")
                middle = curve["middle"]
            density, spread = curve["density"] / unit, curve["density_std"] / unit
            ax.plot(middle * unit, density, dashes, color=colors[source], label=source)
            if curve["n"].iloc[0] > 1:
                between = (density - spread, density + spread)
                ax.fill_between(middle * unit, *between, color=colors[source], alpha=0.2, lw=0)
        hue = channel == "hue"
        ax.set_xlim(*((center - 0.5) * unit, (center + 0.5) * unit) if hue else (0, 1))
        ax.set_ylim(0, None)
        ax.set_xlabel("hue, degrees" if hue else f"{channel}, of 1")
        ax.set_ylabel("density per degree" if hue else "density")
    axes[0].xaxis.set_major_locator(MultipleLocator(90))
    axes[0].xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value % 360:.0f}"))
    style.legend(figure)
    style.footnote(
        figure,
        *(f"{kind}: {_described(own)}" for kind, own in runs.items()),
        points.notation([" ".join(map(_described, runs.values()))]),
        "bands: ± standard deviation over seeds" if histograms["n"].max() > 1 else "n = 1 seed: no bands",
        "the circle of hues is cut open opposite to the truth's mean",
        "grey pixels have no hue: "
        + ", ".join(f"{source} {share:.0%}" for source, share in hsv.greys(samples).items()),
        select(frame).note,
    )
    return figure


def _described(runs: pd.DataFrame) -> str:
    first = runs.iloc[0]
    return f"{first['field']}, density {first['density']}, colour {first['color']}, n = {len(runs)}"
