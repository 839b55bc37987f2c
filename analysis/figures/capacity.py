"""Quality against size: parameters of the heads or of the encoder."""

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from qnerf.metrics import HEAD_PARAMETERS, metric_of

from .. import style
from ..marks import Mark, write_names
from ..selection import select
from . import points

PARTS = {
    "heads": HEAD_PARAMETERS,
    "density": ("params.density",),
    "color": ("params.color",),
    "encoder": ("params.encoder",),
}


def capacity_points(frame: pd.DataFrame, part: str = "heads") -> pd.DataFrame:
    """`points.points` of PSNR (dB) and SSIM, with `params`, the parameter count of a part, and `kind`.

    `kind` is quantum or classical. It describes the part if that is a head ("color", "density"), else the whole field.
    Raises ValueError for an unknown part, or if no run has finished, or none has such a part.
    """
    if part not in PARTS:
        raise ValueError(f"unknown part {part!r}; known: {', '.join(PARTS)}")
    table = points.points(select(frame).runs, ["psnr", "ssim"], PARTS[part])
    table["params"] = table[list(PARTS[part])].sum(axis=1, min_count=1)
    table = table[table["params"] > 0].reset_index(drop=True)
    if table.empty:
        raise ValueError(f"no run has parameters of the {style.HEADS.get(part, part)}")
    return table.assign(kind=[points.kind(field, part) for field in table["field"]])


@style.styled
def capacity_vs_psnr(frame: pd.DataFrame, part: str = "heads") -> Figure:
    """PSNR against the parameters of a part, coloured by SSIM: a row per scene, quantum left, classical right.

    Each mark has the name of its heads.
    """
    finished = select(frame)
    table = capacity_points(frame, part)
    table["mark"], key = points.marked(table, finished.runs, _heads(table, part))
    scenes, kinds = points.scenes(table), sorted(table["kind"].unique(), reverse=True)
    figure = style.new(style.PAGE if len(kinds) > 1 else style.COLUMN, 0.6 + 2.1 * len(scenes))
    axes = figure.subplots(len(scenes), len(kinds), sharex=True, sharey="row", squeeze=False)
    norm = _ssim_norm(table)
    drawn = []
    for row, scene in zip(axes, scenes, strict=True):
        for ax, kind in zip(row, kinds, strict=True):
            shown = table[(table["scene_name"] == scene) & (table["kind"] == kind)]
            drawn += _marks(ax, shown, norm, shown["mark"])
            ax.set(title=f"{scene}: {kind}", xscale="log")
            ax.margins(0.15)
        row[0].set_ylabel(metric_of("psnr").heading)
    style.plain_ticks(axes[-1, 0])
    for ax in axes[-1]:
        ax.set_xlabel(f"parameters of the {style.HEADS.get(part, part)}")
    _ssim_bar(figure, axes, norm)
    style.footnote(figure, points.seeds(table), key, finished.note)
    write_names(figure, drawn)
    return figure


def _heads(table: pd.DataFrame, part: str) -> list[str]:
    """The labels that name a mark: the head that is counted, or both where both differ."""
    heads = [part] if part in style.HEADS else ["density", "color"]
    differing = [head for head in heads if table[head].nunique() > 1] or heads
    return [head for head in differing if table[head].notna().any()]


def _marks(ax: Axes, table: pd.DataFrame, norm: Normalize, names: pd.Series) -> list[Mark]:
    values = zip(table["params"], table["psnr"], table["psnr_std"], names, table["ssim"], strict=True)
    look = {"norm": norm, "cmap": style.SSIM, "edgecolors": style.ink(), "linewidths": 0.5}
    return [Mark(ax, x, y, std, name).draw("o", c=[ssim], **look) for x, y, std, name, ssim in values]


def _ssim_norm(table: pd.DataFrame) -> Normalize:
    return Normalize(table["ssim"].min(), table["ssim"].max())


def _ssim_bar(figure: Figure, axes: np.ndarray, norm: Normalize) -> None:
    figure.colorbar(ScalarMappable(norm, style.SSIM), ax=axes, label=metric_of("ssim").heading, aspect=30, pad=0.02)
