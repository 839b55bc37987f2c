"""Held-out views of several runs side by side: truth, render, error, depth."""

import re
import textwrap
from collections.abc import Iterable
from itertools import islice
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

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
    blocks = [_Block(str(scene), rows) for scene, rows in shown.groupby("scene_name")]
    figure = Figure(figsize=(style.PAGE, sum(block.height for block in blocks) + _FOOT))
    depth = "" if shown["signal"].all() else "; depth: near is bright"
    note = f"each run is the one of median PSNR among its configuration's seeds{depth}"
    style.footnote(figure, note, points.notation(shown["name"]), select(frame).note)
    top = figure.get_figheight()
    for block in blocks:
        block.draw(figure, top)
        top -= block.height
    return figure


def _lines(name: str) -> list[str]:
    """The name in lines that fit beside the pictures, a head or a setting in a line of its own."""
    parts = re.split(r" (?=density |colour )|(?<=,) ", name)
    return [line for part in parts for line in textwrap.wrap(part, 24)]


_LEFT, _GAP, _HEAD, _LINE, _FOOT = 1.3, 0.03, 0.42, 0.16, 0.32  # inches


class _Block:
    """The pictures of one scene, placed by hand: panels of equal size without gaps between rows."""

    def __init__(self, scene: str, rows: pd.DataFrame) -> None:
        self.scene, self.rows = scene, rows
        self.grid = rows.pivot(index="name", columns="image", values="picture").loc[rows["name"].unique()]
        self.titles = TITLES[:-1] if rows["signal"].any() else TITLES
        columns = len(self.titles) * self.grid.shape[1]
        tall, wide = split(rows["picture"].iloc[0], self.titles)[0].shape[:2]
        self.width = min(1.6, (style.PAGE - _LEFT - _GAP * columns) / columns)
        self.tall = self.width * tall / wide
        self.height = _HEAD + len(self.grid) * (self.tall + _LINE)

    def draw(self, figure: Figure, top: float) -> None:
        """top: inches from the lower edge of the figure."""
        width, height = figure.get_size_inches()
        figure.text(_LEFT / width, (top - 0.14) / height, self.scene, fontsize=8)
        for row, (name, line) in enumerate(self.grid.iterrows()):
            y = top - _HEAD - row * (self.tall + _LINE) - self.tall
            run = self.rows[self.rows["name"] == name]
            psnr = dict(zip(run["image"], run["psnr"], strict=True))
            x, middle = (_LEFT - 0.06) / width, (y + self.tall / 2) / height
            text = "\n".join(_lines(str(name))) + f"\nseed {run['seed'].iloc[0]}"
            figure.text(x, middle, text, fontsize=style.NOTE, ha="right", va="center")
            for view, (image, picture) in enumerate(line.to_dict().items()):
                for column, (title, panel) in enumerate(zip(self.titles, split(picture, self.titles), strict=True)):
                    x = _LEFT + (len(self.titles) * view + column) * (self.width + _GAP)
                    ax = figure.add_axes((x / width, y / height, self.width / width, self.tall / height))
                    ax.imshow(panel, aspect="auto")
                    ax.set_axis_off()
                    if row == 0:
                        ax.set_title(title, fontsize=style.MARK, pad=2)
                    if title == "render":
                        text = f"{psnr[image]:.2f} dB"
                        ax.text(0.5, -0.02, text, transform=ax.transAxes, fontsize=style.NOTE, ha="center", va="top")
