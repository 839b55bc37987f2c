"""Matplotlib's figures as data URIs; one that cannot be drawn is a line that says why."""

import base64
from dataclasses import dataclass

import pandas as pd
from matplotlib.figure import Figure

from ..figures import FIGURES
from ..figures.files import collecting
from ..style import rendered

PIXELS_AN_INCH = 140  # on the page: text of 7 points is 13.6 pixels high
MAX_SVG = 1_000_000  # bytes; a figure of ten thousand points is smaller as PNG
KINDS = {"svg": "image/svg+xml", "png": "image/png"}


@dataclass(frozen=True)
class Drawn:
    """A figure with its size on the page in pixels."""

    title: str
    image: str
    width: int
    height: int


def draw(name: str, frame: pd.DataFrame, baseline: str | None = None) -> tuple[list[Drawn], list[str]]:
    """The figure of `FIGURES`, one a scene where it speaks of one scene, and why it cannot be drawn where it cannot."""
    entry, title = FIGURES[name], FIGURES[name].title
    drawn: list[Drawn] = []
    absent: dict[str, str] = {}
    scenes = entry.scenes(name, frame)
    for runs in scenes.values():
        own = f"{title}: {runs['scene_name'].iloc[0]}" if len(scenes) > 1 else title
        with collecting(absent, own):
            drawn.append(embedded(own, entry.draw(runs, baseline=baseline)))
    absent = {own: "; ".join(filter(None, [reason, entry.hint])) for own, reason in absent.items()}
    if absent and not drawn:
        absent = {title: next(iter(absent.values()))}
    return drawn, [f"{own}: {reason}" for own, reason in absent.items()]


def embedded(title: str, figure: Figure) -> Drawn:
    width, height = (round(inches * PIXELS_AN_INCH) for inches in figure.get_size_inches())
    return Drawn(title, data_uri(*encoded(figure)), width, height)


def encoded(figure: Figure) -> tuple[str, bytes]:
    """As SVG, or as PNG where that would be too large."""
    svg = rendered(figure, "svg")
    return ("svg", svg) if len(svg) <= MAX_SVG else ("png", rendered(figure, "png"))


def data_uri(kind: str, data: bytes) -> str:
    return f"data:{KINDS[kind]};base64,{base64.b64encode(data).decode()}"
