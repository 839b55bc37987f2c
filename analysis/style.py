"""The look of every figure: sizes for a two-column page, colours that colour-blind readers can tell apart, and files
that are the same bytes each time."""

import functools
import io
import math
import textwrap
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backend_bases import FigureCanvasBase
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

from qnerf.records.printable import printable

from . import output

COLUMN, PAGE = 3.35, 6.9  # inches

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C6D1F", "#888888")
"""The colours of Okabe and Ito, with brown and grey instead of yellow and black, which are hard to see on white or dark
paper."""
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
LINES = ("-", "--", "-.", ":")
SSIM = "cividis"
FIELDS = {
    "classical": ("#E69F00", "s"),
    "qcolor": ("#0072B2", "o"),
    "qdensity": ("#CC79A7", "^"),
    "qboth": ("#009E73", "D"),
    "quantum": ("#D55E00", "o"),
}
"""Colour and marker of each field, the same in every figure."""
HEADS = {"color": "colour head", "density": "density head"}
FORMATS = ("png", "svg", "pdf")

_BASE: dict[str, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans", "Verdana", "Arial", "sans-serif"],
    "font.size": 7,
    "axes.titlesize": 7.5,
    "axes.labelsize": 7,
    "xtick.labelsize": 6.5,
    "ytick.labelsize": 6.5,
    "legend.fontsize": 6.5,
    "legend.framealpha": 0.8,
    "legend.edgecolor": "none",
    "legend.borderpad": 0.2,
    "lines.linewidth": 1.1,
    "lines.markersize": 4.5,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.linewidth": 0.4,
    "grid.alpha": 0.35,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.minor.width": 0.4,
    "ytick.minor.width": 0.4,
    "errorbar.capsize": 2,
    "image.interpolation": "nearest",
    "savefig.dpi": 300,
    "svg.fonttype": "none",
    "svg.hashsalt": "qnerf",
    "pdf.fonttype": 42,
}
_INK = {"light": ("#1a1a1a", "#ffffff"), "dark": ("#e6e6e6", "#16181d")}
_INKED = ("text.color", "axes.labelcolor", "axes.edgecolor", "axes.titlecolor", "xtick.color", "ytick.color")
_PAPER = ("figure.facecolor", "axes.facecolor", "savefig.facecolor", "legend.facecolor")


def settings(theme: str = "light") -> dict[str, Any]:
    """Matplotlib's parameters for a theme, light or dark. Raises ValueError for any other name."""
    if theme not in _INK:
        raise ValueError(f"unknown theme {theme!r}; known: {', '.join(_INK)}")
    ink, paper = _INK[theme]
    return _BASE | dict.fromkeys(_INKED, ink) | dict.fromkeys(_PAPER, paper) | {"grid.color": ink}


def styled(draw: Callable[..., Figure]) -> Callable[..., Figure]:
    """Gives a figure function the option `theme`, light or dark, and shields it from the caller's own rcParams."""

    @functools.wraps(draw)
    def drawn(*arguments: Any, theme: str = "light", **options: Any) -> Figure:
        parameters: dict[Any, Any] = mpl.rcParamsDefault | settings(theme)
        with mpl.rc_context(parameters):
            figure = draw(*arguments, **options)
            make_plain(figure)
            return figure

    return drawn


def make_plain(figure: Figure) -> None:
    """Draws the figure's texts as they are, whatever names a store holds: no mathtext, no control characters.

    Labels of ticks stay as their formatters write them.
    """
    for text in _texts(figure):
        text.set_parse_math(False)
        text.set_text(printable(text.get_text(), lines=True))


def _texts(artist: Artist) -> Iterator[Text]:
    if isinstance(artist, Text):
        yield artist
    elif isinstance(artist, Axis):
        yield artist.label  # asking for its ticks would fail on a logarithmic axis without data
    else:
        for child in artist.get_children():
            yield from _texts(child)


def ink() -> str:
    """The text colour of the current theme."""
    return str(mpl.rcParams["text.color"])


def new(width: float, height: float) -> Figure:
    """An empty figure of this size in inches, with constrained layout."""
    return Figure(figsize=(width, height), layout="constrained")


def panels(count: int, height: float, **subplots: Any) -> tuple[Figure, np.ndarray]:
    """A figure of `height` inches with a row of panels: one is as wide as a column, several as wide as the page."""
    figure = new(COLUMN if count == 1 else PAGE, height)
    return figure, figure.subplots(1, count, squeeze=False, **subplots)[0]


def series(number: int) -> dict[str, Any]:
    """Colour and marker of the n-th line."""
    return {"color": PALETTE[number % len(PALETTE)], "marker": MARKERS[number % len(MARKERS)]}


def plain_ticks(ax: Axes) -> None:
    """Labels a logarithmic x axis with plain numbers (2k, 50k, 1M).

    Ticks are equally spaced on an axis of less than half a decade, at 1, 2 and 5 below two decades, else at powers of
    ten.
    """
    low, high = ax.get_xlim()
    decades = math.log10(high / low)
    if decades < 0.5:
        ax.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
        ax.xaxis.set_minor_locator(NullLocator())
    else:
        ax.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if decades < 2 else (1,)))
    ax.xaxis.set_major_formatter(FuncFormatter(_plain))
    ax.xaxis.set_minor_formatter(NullFormatter())


def _plain(value: float, _: int | None = None) -> str:
    for unit, name in ((1e6, "M"), (1e3, "k")):
        if value >= unit:
            return f"{value / unit:g}{name}"
    return f"{value:g}"


def legend(figure: Figure, columns: int = 3) -> None:
    """One legend above all panels, which lists each label once."""
    handles: dict[str, Artist] = {}
    for ax in figure.axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(list(handles.values()), list(handles), loc="outside upper left", ncols=columns)


def footnote(figure: Figure, *parts: str) -> None:
    """Writes below the panels what the axes do not show: number of seeds, runs left out. Empty parts are dropped."""
    text = "; ".join(part for part in parts if part)
    if text:
        wrapped = textwrap.fill(text, int(figure.get_figwidth() * 23))
        figure.supxlabel(wrapped, x=0.01, ha="left", fontsize=5.5, alpha=0.8)


def save(figure: Figure, path: str | Path, formats: Iterable[str] = FORMATS) -> list[Path]:
    """Writes path.png, path.svg and path.pdf and returns their paths.

    Text stays text and no date is written, so the same figure gives the same bytes.

    Raises:
        ValueError: matplotlib does not know a format, or there is a link at one of the paths.
        OSError: a file cannot be written.
    """
    written = []
    for kind in formats:
        target = Path(f"{path}.{kind}")
        dates = {"svg": {"Date": None}, "pdf": {"CreationDate": None}, "png": {"Software": None}}
        with mpl.rc_context(
            {key: _BASE[key] for key in ("svg.fonttype", "svg.hashsalt", "pdf.fonttype", "savefig.dpi")}
        ):
            options = {"format": kind, "metadata": dates.get(kind), "facecolor": figure.get_facecolor()}
            data = io.BytesIO()
            figure.savefig(data, **options)
            output.write(target, data.getvalue())
        written.append(target)
    return written


def check_formats(formats: Iterable[str]) -> None:
    """ValueError for a format that matplotlib does not know."""
    known = FigureCanvasBase.get_supported_filetypes()
    for kind in formats:
        if kind not in known:
            raise ValueError(f"unknown format {kind!r}; known: {', '.join(sorted(known))}")
