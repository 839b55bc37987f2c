"""Matplotlib's figures as data URIs; one that cannot be drawn is a line that says why."""

import base64
from dataclasses import dataclass
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from ..figures import FIGURES
from ..figures.files import collecting
from ..style import rendered

PIXELS_AN_INCH = 140  # on the page: text of 7 points is 13.6 pixels high


@dataclass(frozen=True)
class Drawn:
    """A figure with its size on the page in pixels; kind: "ink", which a dark page inverts, or "pictures"."""

    title: str
    image: str
    width: int
    height: int
    kind: str


def draw(name: str, frame: pd.DataFrame, **judged: Any) -> tuple[list[Drawn], dict[str, str]]:
    """The figure of `FIGURES`, one a scene where it speaks of one scene, and title -> why it cannot be drawn."""
    entry, title = FIGURES[name], FIGURES[name].title
    drawn: list[Drawn] = []
    absent: dict[str, str] = {}
    scenes = entry.scenes(name, frame)
    for runs in scenes.values():
        own = f"{title}: {runs['scene_name'].iloc[0]}" if len(scenes) > 1 else title
        with collecting(absent, own):
            drawn.append(embedded(own, entry.draw(runs, **judged)))
    if absent and not drawn:
        absent = {title: next(iter(absent.values()))}
    return drawn, absent


def embedded(title: str, figure: Figure) -> Drawn:
    width, height = (round(inches * PIXELS_AN_INCH) for inches in figure.get_size_inches())
    image = base64.b64encode(rendered(figure, "svg")).decode()
    kind = "pictures" if any(ax.images for ax in figure.axes) else "ink"
    return Drawn(title, f"data:image/svg+xml;base64,{image}", width, height, kind)
