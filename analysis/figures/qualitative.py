"""Held-out views of several runs side by side: truth, render, error, depth."""

import re
import textwrap
from collections.abc import Iterable, Sequence
from itertools import islice
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure, SubFigure

from qnerf.config.identity import picture_names

from .. import style
from ..images import common_pictures, split
from ..selection import select
from ..verdict import evaluations
from . import points

TITLES = ("truth", "render", "error x 4", "depth")


def typical(frame: pd.DataFrame, most: int = 5) -> pd.DataFrame:
    """The seed of median PSNR of each of the `most` best configurations of a scene.

    Columns of `points.points` with that run's psnr, `seed` and `path`.
    """
    runs = select(frame).runs
    table, _ = points.best(runs, ["psnr"], most)
    chosen = [runs.loc[list(rows)].sort_values("psnr").iloc[(len(rows) - 1) // 2] for rows in table["runs"]]
    return table.assign(**{key: [run[key] for run in chosen] for key in ("seed", "path", "psnr")})


def qualitative_panels(chosen: pd.DataFrame, views: int = 1) -> pd.DataFrame:
    """The pictures to draw: the first `views` held-out views that all runs of a scene have pictures of.

    Columns scene_name, name, signal (the picture has no depth), seed, image, psnr (dB, of that image alone), picture (a
    path). A scene whose runs have no picture in common is left out; ValueError if none is left.
    """
    rows = []
    measured = {path: row.dropna() for path, row in evaluations(chosen).iterrows()}
    psnr = {path: dict(zip(picture_names(list(row.index)), row, strict=True)) for path, row in measured.items()}
    for scene, runs in chosen.groupby("scene_name"):
        names, pictures = common_pictures(runs["path"])
        readable = (name for name in names if _are_readable(own[name] for own in pictures.values()))
        common = list(islice(readable, views))
        for _, run in runs.iterrows():
            for image in common:
                quality = psnr.get(run["path"], {}).get(image, float("nan"))
                signal, picture = pd.notna(run["head"]), pictures[run["path"]][image]
                rows.append((scene, run["name"], signal, run["seed"], image, quality, picture))
    if not rows:
        raise ValueError(f"no picture that all {len(chosen)} chosen runs of a scene have")
    return pd.DataFrame(rows, columns=["scene_name", "name", "signal", "seed", "image", "psnr", "picture"])


def _are_readable(pictures: Iterable[Path]) -> bool:
    try:
        for picture in pictures:
            split(picture, ["whole"])
    except ValueError:
        return False
    return True


@style.styled
def qualitative_grid(frame: pd.DataFrame, views: int = 2, most: int = 4) -> Figure:
    """truth | render | error | depth of a typical run of each configuration: a row per run, a block per scene."""
    shown = qualitative_panels(typical(frame, most), views)
    scenes = list(shown.groupby("scene_name"))
    heights = [_height(rows) for _, rows in scenes]
    figure = style.new(style.PAGE, sum(heights) + _FOOT)
    for part, (scene, rows) in zip(
        figure.subfigures(len(scenes), 1, squeeze=False, height_ratios=heights), scenes, strict=True
    ):
        part[0].suptitle(scene, fontsize=8)
        _draw(part[0], rows)
    depth = "" if shown["signal"].all() else "; depth: near is bright"
    note = f"each run is the one of median PSNR among its configuration's seeds{depth}"
    style.footnote(figure, note, points.notation(shown["name"]), select(frame).note)
    return figure


def _titles(rows: pd.DataFrame) -> Sequence[str]:
    return TITLES[:-1] if rows["signal"].any() else TITLES


_LEFT, _HEAD, _LINE, _FOOT = 1.3, 0.4, 0.18, 0.2  # inches beside the pictures, above and under them


def _height(rows: pd.DataFrame) -> float:
    """Inches of a scene's block, in which the pictures are as wide as the page allows."""
    height, width = split(rows["picture"].iloc[0], _titles(rows))[0].shape[:2]
    widest = min(1.6, (style.PAGE - _LEFT) / len(_titles(rows)) / rows["image"].nunique())
    return _HEAD + rows["name"].nunique() * (widest * height / width + _LINE)


def _draw(figure: SubFigure, rows: pd.DataFrame) -> None:
    titles, images = _titles(rows), rows["image"].nunique()
    axes = figure.subplots(rows["name"].nunique(), len(titles) * images, squeeze=False)
    for line, (name, runs) in zip(axes, rows.groupby("name", sort=False), strict=True):
        text = "\n".join([*_lines(str(name)), f"seed {runs['seed'].iloc[0]}"])
        line[0].set_ylabel(text, fontsize=style.NOTE, rotation=0, ha="right", va="center")
        for panels, (_, run) in zip(np.split(line, images), runs.iterrows(), strict=True):
            for ax, pixels in zip(panels, split(run["picture"], titles), strict=True):
                ax.imshow(pixels)
                ax.set(xticks=[], yticks=[], frame_on=False)
            panels[1].set_xlabel(f"{run['psnr']:.2f} dB", fontsize=style.NOTE, labelpad=1)
    for ax, title in zip(axes[0], [*titles] * images, strict=True):
        ax.set_title(title, fontsize=style.MARK, pad=2)


def _lines(name: str) -> list[str]:
    """The name in lines that fit beside the pictures, a head or a setting in a line of its own."""
    parts = re.split(r" (?=density |colour )|(?<=,) ", name)
    return [line for part in parts for line in textwrap.wrap(part, 24)]
