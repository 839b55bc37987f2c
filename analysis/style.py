"""The look of every figure: sizes for a two-column page, colours that colour-blind readers can tell apart, and files
that are the same bytes each time."""

import functools
import io
import math
import re
import textwrap
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import to_hex, to_rgb
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure, SubFigure
from matplotlib.text import Text
from matplotlib.textpath import TextPath
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

from qnerf.records.files import replace
from qnerf.records.printable import printable

COLUMN, PAGE = 3.3, 6.9  # inches
NOTE, MARK = 6.5, 7.0  # points: footnotes, names of marks; everything else is larger

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C6D1F", "#888888")
"""The colours of Okabe and Ito, with brown and grey instead of yellow and black, which are hard to see on white or dark
paper."""
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
SSIM = "cividis"
FIELDS = {
    "classical": ("#E69F00", "s"),
    "qcolor": ("#0072B2", "o"),
    "qdensity": ("#CC79A7", "^"),
    "qboth": ("#009E73", "D"),
    "quantum": ("#D55E00", "o"),
}
"""Colour and marker of each field, the same in every figure."""
SHADES = (("text.color", 0.0), ("text.color", 0.5), ("axes.facecolor", 0.45), ("text.color", 0.25))
"""What a field's colour is mixed with, and how much of it, for the further configurations of that field."""
HEADS = {"color": "colour head", "density": "density head"}
FORMATS = ("png", "svg", "pdf")

_INKED = (
    "text.color",
    "axes.labelcolor",
    "axes.edgecolor",
    "axes.titlecolor",
    "xtick.color",
    "ytick.color",
    "grid.color",
)
_BASE: dict[str, Any] = dict.fromkeys(_INKED, "#1a1a1a") | {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans", "Verdana", "Arial", "sans-serif"],
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "legend.fontsize": 7.5,
    "legend.framealpha": 0.8,
    "legend.edgecolor": "none",
    "legend.borderpad": 0.2,
    "lines.linewidth": 1.1,
    "lines.markersize": 4.5,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
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
_UNNAMED = re.compile(r"_(child|container)\d+|_nolegend_")  # matplotlib's own labels


def styled(draw: Callable[..., Figure]) -> Callable[..., Figure]:
    """Draws a figure with these parameters, whatever the caller's own rcParams."""

    @functools.wraps(draw)
    def drawn(*arguments: Any, **options: Any) -> Figure:
        parameters: dict[Any, Any] = mpl.rcParamsDefault | _BASE
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
    """The colour of texts and outlines."""
    return str(mpl.rcParams["text.color"])


def new(width: float, height: float) -> Figure:
    """An empty figure of this size in inches, with constrained layout."""
    return Figure(figsize=(width, height), layout="constrained")


def panels(count: int, height: float, **subplots: Any) -> tuple[Figure, np.ndarray]:
    """A figure with rows of up to three panels, each row `height` inches high.

    One panel is as wide as a column, several as wide as the page.
    """
    columns = min(3, count)
    rows = -(-count // columns)
    figure = new(COLUMN if count == 1 else PAGE, height * rows)
    axes = figure.subplots(rows, columns, squeeze=False, **subplots).ravel()
    for ax in axes[count:]:
        ax.remove()
    return figure, axes[:count]


def look_of(field: str) -> tuple[str, str]:
    """Colour and marker of a field; a tracked run's has none of its own."""
    return FIELDS.get(field, (PALETTE[-1], MARKERS[0]))


def looks(fields: Iterable[str]) -> list[dict[str, Any]]:
    """Colour and marker of each configuration: the colour of its field, in another shade where a field comes again.

    The first of a field has the field's marker, the others have the other markers.
    """
    seen: Counter[str] = Counter()
    result = []
    for field in fields:
        color, first = look_of(field)
        markers = [first, *(marker for marker in MARKERS if marker != first)]
        other, part = SHADES[seen[field] % len(SHADES)]
        result.append({"color": mixed(color, other, part), "marker": markers[seen[field] % len(markers)]})
        seen[field] += 1
    return result


def mixed(color: str, other: str, part: float) -> str:
    """A colour with a part, 0 to 1, of another, `axes.facecolor` or `text.color`."""
    return to_hex((1 - part) * np.array(to_rgb(color)) + part * np.array(to_rgb(mpl.rcParams[other])))


def plain_ticks(ax: Axes) -> None:
    """Labels a logarithmic x axis with plain numbers (2k, 50k, 1M), at least three of them.

    Ticks are at powers of ten, or also at 3, or at 2 and 5; where these are too few, they are equally spaced.
    """
    low, high = ax.get_xlim()
    ax.xaxis.set_major_formatter(PLAIN)
    ax.xaxis.set_minor_formatter(NullFormatter())
    for subs in ((1,), (1, 3), (1, 2, 5)):
        decades = 10.0 ** np.arange(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        ticks = np.outer(decades, subs)
        if ((ticks >= low) & (ticks <= high)).sum() >= 3:
            ax.xaxis.set_major_locator(LogLocator(subs=subs, numticks=20))
            return
    ax.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    ax.xaxis.set_minor_locator(NullLocator())


def _plain(value: float, _: int | None = None) -> str:
    for unit, name in ((1e6, "M"), (1e3, "k")):
        if value >= unit:
            return f"{value / unit:g}{name}"
    return f"{value:g}"


PLAIN = FuncFormatter(_plain)
"""Writes 1k for 1000 and 2M for 2000000 at ticks."""


def text_width(text: str, size: float) -> float:
    """Width of a line in points, drawn as it is: a dollar sign begins no formula."""
    plain = text.replace("$", r"\$")
    return float(TextPath((0, 0), plain, size=size, usetex=False).get_extents().width) if text.strip() else 0.0


def legend(figure: Figure | SubFigure) -> None:
    """One legend above all panels, which lists each label once, in as many columns as fit.

    It shows marks and lines without error bars, which not every point has. The figure grows by its height.
    """
    size = mpl.rcParams["legend.fontsize"]
    handles: dict[str, Artist] = {}
    for ax in figure.axes:
        for handle in [*ax.lines, *ax.collections, *ax.containers]:  # not by matplotlib, which skips names with "_"
            if (label := handle.get_label()) and not _UNNAMED.fullmatch(str(label)):
                handles.setdefault(str(label), handle.lines[0] if isinstance(handle, ErrorbarContainer) else handle)
    whole = figure.figure if isinstance(figure, SubFigure) else figure
    room, beside = whole.get_figwidth() * 72 - size, 4.6 * size  # beside: the handle, and gaps between columns
    most = int((room - beside) / (0.56 * size))
    names = [textwrap.fill(printable(name), most, break_long_words=False) for name in handles]
    widest = max(text_width(line, size) for name in names for line in name.split("\n")) + beside
    columns = max(1, min(len(names), int(room // widest)))
    shown = [f"\N{ZERO WIDTH SPACE}{name}" for name in names]
    drawn = figure.legend(list(handles.values()), shown, loc="outside upper left", ncols=columns)
    for text, name in zip(drawn.get_texts(), names, strict=True):
        text.set_text(name)
    drawn.set_gid("legend")
    lines = sum(sorted((name.count("\n") + 1 for name in names), reverse=True)[: -(-len(names) // columns)])
    whole.set_figheight(whole.get_figheight() + lines * 1.7 * size / 72)


def footnote(figure: Figure, *parts: str) -> None:
    """Writes below the panels what the axes do not show: number of seeds, runs left out. Empty parts are dropped."""
    text = "; ".join(part for part in parts if part)
    if text:
        wrapped = textwrap.fill(text, int(figure.get_figwidth() * 19.5))
        lines = wrapped.count("\n") - figure.get_supxlabel().count("\n")
        figure.supxlabel(wrapped, x=0.01, ha="left", fontsize=NOTE, alpha=0.8)
        figure.set_figheight(figure.get_figheight() + lines * 1.2 * NOTE / 72)


def save(figure: Figure, path: str | Path, formats: Iterable[str] = FORMATS) -> list[Path]:
    """Writes path.png, path.svg and path.pdf and returns their paths.

    Raises:
        ValueError: matplotlib does not know a format, or a file cannot be written.
    """
    written = {Path(f"{path}.{kind}"): rendered(figure, kind) for kind in formats}
    for target, data in written.items():
        replace(target, data, durable=False)
    return list(written)


def rendered(figure: Figure, kind: str) -> bytes:
    """The figure as png, svg or pdf. Text stays text and no date is written: the same figure gives the same bytes."""
    dates = {"svg": {"Date": None}, "pdf": {"CreationDate": None}, "png": {"Software": None}}
    data = io.BytesIO()
    with mpl.rc_context({key: _BASE[key] for key in ("svg.fonttype", "svg.hashsalt", "pdf.fonttype", "savefig.dpi")}):
        figure.savefig(data, format=kind, metadata=dates.get(kind), facecolor=figure.get_facecolor())
    return data.getvalue()
