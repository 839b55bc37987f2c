"""Marks with bars and names: a name stands at the nearest free place beside its mark."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from qnerf.records.printable import printable

from . import style

RADIUS = 3.2  # points
DISTANCES = (5.0, 8.0, 12.0, 17.0, 23.0, 30.0, 38.0, 47.0, 57.0, 68.0, 80.0)  # points from a mark to its name
BESIDE_MARK = 8.0  # points; a line leads to names that are farther away
DIRECTIONS = [(math.cos(turn), math.sin(turn)) for turn in (np.arange(24) + 2) * math.pi / 12]


@dataclass
class Mark:
    """A mean at (x, y) in data units, with the standard deviation of y (NaN: no bar) and the name to write beside."""

    ax: Axes
    x: float
    y: float
    spread: float = math.nan
    name: str = ""

    def draw(self, marker: str, **look: Any) -> "Mark":
        """Draws the mark and its bar. look: as for `Axes.scatter`."""
        if math.isfinite(self.spread):
            color = look.get("color", style.ink())
            bar = {"ecolor": color, "elinewidth": 0.7, "capsize": 1.5, "zorder": 2}
            self.ax.errorbar([self.x], [self.y], [self.spread], fmt="none", **bar)
        self.ax.scatter([self.x], [self.y], s=26, marker=marker, zorder=3, **look)
        return self

    def box(self) -> np.ndarray:
        """Left, low, right and high end of mark and bar, in points."""
        spread = self.spread if math.isfinite(self.spread) else 0.0
        ends = self.ax.transData.transform([(self.x, self.y - spread), (self.x, self.y + spread)])
        low, high = ends * 72 / self.ax.figure.dpi
        return np.concatenate([low - RADIUS, high + RADIUS])


def write_names(figure: Figure, marks: Sequence[Mark]) -> None:
    """Writes the names of the marks, over nothing that is drawn. The footnote counts the marks without room for one.

    Everything else of the figure must be drawn.
    """
    style.make_plain(figure)
    figure.draw_without_rendering()  # the layout decides how large the panels are
    unnamed = sum(_write_beside([mark for mark in marks if mark.ax is ax]) for ax in {mark.ax for mark in marks})
    if unnamed:
        note = " ".join(figure.get_supxlabel().split("\n"))
        style.footnote(figure, note, f"marks without room for a name: {unnamed}")


def _write_beside(marks: Sequence[Mark]) -> int:
    """Returns how many found no room."""
    ax = marks[0].ax
    inside = np.array(ax.get_window_extent().extents) * 72 / ax.figure.dpi
    taken, unnamed = [mark.box() for mark in marks], 0
    for mark in marks:
        name, at = printable(mark.name), ax.transData.transform((mark.x, mark.y)) * 72 / ax.figure.dpi
        size = np.array([style.text_width(name, style.MARK) + 2, 1.15 * style.MARK])
        center = _room(at, size, inside, np.array(taken)) if name else None
        unnamed += bool(name) and center is None
        if center is not None:
            taken.append(np.concatenate([center - size / 2, center + size / 2]))
            _write(mark, name, center - at, size)
    return unnamed


def _room(at: np.ndarray, size: np.ndarray, inside: np.ndarray, taken: np.ndarray) -> np.ndarray | None:
    """Middle of the nearest free box of this size, all in points; None if all places are taken."""
    for distance in DISTANCES:
        for direction in DIRECTIONS:
            center = at + np.array(direction) * (distance + size / 2)
            low, high = center - size / 2, center + size / 2
            within = (low >= inside[:2]).all() and (high <= inside[2:]).all()
            if within and not ((low < taken[:, 2:]) & (taken[:, :2] < high)).all(axis=1).any():
                return center
    return None


def _write(mark: Mark, name: str, offset: np.ndarray, size: np.ndarray) -> None:
    gap = float(np.linalg.norm(np.maximum(np.abs(offset) - size / 2, 0)))
    arrow = {"arrowstyle": "-", "lw": 0.4, "color": style.ink(), "alpha": 0.7, "shrinkA": 0, "shrinkB": RADIUS}
    text = mark.ax.annotate(
        name, (mark.x, mark.y), tuple(offset), textcoords="offset points", ha="center", va="center",
        fontsize=style.MARK, arrowprops=arrow if gap > BESIDE_MARK else None, annotation_clip=False, zorder=4,
    )  # fmt: skip
    text.set_in_layout(False)
