"""Quality against size: parameters, depth, width and hash tables."""

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from qnerf.metrics import metric_of

from .. import style
from ..selection import select
from ..settings import QUANTUM
from . import points

PARTS = {
    "heads": ("params.density", "params.color"),
    "density": ("params.density",),
    "color": ("params.color",),
    "encoder": ("params.encoder",),
    "encoder and density": ("params.encoder", "params.density"),
}


def capacity_points(frame: pd.DataFrame, part: str = "heads") -> pd.DataFrame:
    """`points.points` of PSNR (dB) and SSIM with `params`, the parameters of a part, and `kind`: quantum | classical.

    A run counts as quantum by the part: its colour head for "color", its density head for "density", else either.
    ValueError for an unknown part or where no run has finished.
    """
    if part not in PARTS:
        raise ValueError(f"unknown part {part!r}; known: {', '.join(PARTS)}")
    table = points.points(select(frame).runs, ["psnr", "ssim"], PARTS[part])
    quantum = table["field"].isin(QUANTUM[part]) if part in QUANTUM else table["field"] != "classical"
    return table.assign(params=table[list(PARTS[part])].sum(axis=1), kind=np.where(quantum, "quantum", "classical"))


@style.styled
def capacity_vs_psnr(frame: pd.DataFrame, part: str = "heads") -> Figure:
    """PSNR against the parameters of a part, coloured by SSIM: quantum beside classical, one row a scene."""
    table = capacity_points(frame, part)
    scenes, kinds = points.scenes(table), [kind for kind in ("quantum", "classical") if kind in set(table["kind"])]
    figure = style.new(style.PAGE if len(kinds) > 1 else style.COLUMN, 0.6 + 2.1 * len(scenes))
    axes = figure.subplots(len(scenes), len(kinds), sharex=True, sharey="row", squeeze=False)
    norm = _ssim_norm(table)
    for row, scene in zip(axes, scenes, strict=True):
        for ax, kind in zip(row, kinds, strict=True):
            _scatter(ax, table[(table["scene_name"] == scene) & (table["kind"] == kind)], norm)
            ax.set(title=f"{scene}: {kind}", xscale="log")
            ax.margins(0.12)
        row[0].set_ylabel(metric_of("psnr").heading)
    style.plain_ticks(axes[-1, 0])
    for ax in axes[-1]:
        ax.set_xlabel(f"parameters of the {_named(part)}")
    _ssim_bar(figure, axes, norm)
    style.footnote(figure, points.seeds(table), select(frame).note)
    return figure


def hash_points(frame: pd.DataFrame) -> pd.DataFrame:
    """`capacity_points` of the runs with a hash encoding, `params` being those of table and density head.

    `line`: names the configurations that differ in their table alone; one without such a partner is left out.
    ValueError where none has.
    """
    selected = select(frame).runs
    hashed = selected[selected["encoder"] == "hash"]
    if hashed.empty:
        raise ValueError(f"no run has encoder=hash; there are {', '.join(sorted(selected['encoder'].unique()))}")
    table = capacity_points(hashed, "encoder and density")
    table["family"] = points.families(table, hashed, ["encoder."])
    table = table[table.groupby("family")["hash"].transform("nunique") > 1].reset_index(drop=True)
    if table.empty:
        raise ValueError("no two configurations differ in their hash table alone; C1 to C7: hash=C1,C5,C7")
    firsts = table.drop_duplicates("family")
    lines = points.names(firsts.assign(hash=""), hashed, apart=["encoder."])
    return table.assign(line=table["family"].map(dict(zip(firsts["family"], lines, strict=True))))


@style.styled
def hash_configurations(frame: pd.DataFrame) -> Figure:
    """PSNR of the hash tables C1 to C7 against parameters, coloured by SSIM: one panel a scene, one line a family."""
    table = hash_points(frame)
    names = points.scenes(table)
    figure = style.new(max(style.COLUMN, 2.6 * len(names)), 2.7)
    axes = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    norm = _ssim_norm(table)
    for ax, scene in zip(axes, names, strict=True):
        families = table[table["scene_name"] == scene].groupby("line")
        for number, (line, family) in enumerate(families):
            marker, dashes = style.MARKERS[number % len(style.MARKERS)], style.LINES[number % len(style.LINES)]
            family = family.sort_values("params")
            ax.plot(family["params"], family["psnr"], dashes, color=style.ink(), alpha=0.4, lw=0.8, label=line)
            _scatter(ax, family, norm, marker)
            for _, point in family.iterrows():
                ax.annotate(point["hash"], (point["params"], point["psnr"]), (4, -8), textcoords="offset points")
        ax.set(title=scene, xscale="log", xlabel="parameters of hash table and density head")
        ax.margins(0.12)
        style.plain_ticks(ax)
        if len(families) > 1:
            ax.legend()
    axes[0].set_ylabel(metric_of("psnr").heading)
    _ssim_bar(figure, axes, norm)
    style.footnote(figure, points.seeds(table), select(frame).note)
    return figure


def _scatter(ax: Axes, table: pd.DataFrame, norm: Normalize, marker: str = "o") -> None:
    ax.errorbar(
        table["params"], table["psnr"], table["psnr_std"], fmt="none", ecolor=style.ink(), elinewidth=0.7, zorder=2
    )
    ax.scatter(
        table["params"], table["psnr"], c=table["ssim"], norm=norm, cmap=style.SSIM, marker=marker, s=26,
        edgecolors=style.ink(), linewidths=0.5, zorder=3,
    )  # fmt: skip


def _ssim_norm(table: pd.DataFrame) -> Normalize:
    return Normalize(table["ssim"].min(), table["ssim"].max())


def _ssim_bar(figure: Figure, axes: np.ndarray, norm: Normalize) -> None:
    figure.colorbar(ScalarMappable(norm, style.SSIM), ax=axes, label=metric_of("ssim").heading, aspect=30, pad=0.02)


def _named(part: str) -> str:
    return {"heads": "heads", "density": "density head", "color": "colour head", "encoder": "encoder"}.get(part, part)
