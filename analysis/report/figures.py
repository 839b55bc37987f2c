"""Matplotlib's figures as data URIs; one that cannot be drawn is a line that says why."""

import base64
from collections.abc import Iterable
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


def draw(names: Iterable[str], frame: pd.DataFrame, **judged: Any) -> tuple[list[Drawn], dict[str, str]]:
    """These figures of `FIGURES`, and title -> why one cannot be drawn."""
    drawn: list[Drawn] = []
    absent: dict[str, str] = {}
    for entry in map(FIGURES.__getitem__, names):
        with collecting(absent, entry.title):
            drawn.append(embedded(entry.title, entry.draw(frame, **judged)))
    return drawn, absent


def embedded(title: str, figure: Figure) -> Drawn:
    width, height = (round(inches * PIXELS_AN_INCH) for inches in figure.get_size_inches())
    image = base64.b64encode(rendered(figure, "svg")).decode()
    kind = "pictures" if any(ax.images for ax in figure.axes) else "ink"
    return Drawn(title, f"data:image/svg+xml;base64,{image}", width, height, kind)
