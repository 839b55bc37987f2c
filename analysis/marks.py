"""Marks with bars and names: those that would cover each other are moved apart, and names stand where there is room."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import ScaledTranslation

from qnerf.records.printable import printable

from . import style

RADIUS = 3.2  # points
BARS, MARKS = 2.5, 5.5  # points between bars, and between marks, that would cover each other
ASIDE = 10.0  # points that a mark is moved at most
DISTANCES = (5.0, 8.0, 12.0, 17.0, 23.0, 30.0, 38.0, 47.0, 57.0, 68.0, 80.0)  # points from a mark to its name
BESIDE_MARK = 8.0  # points; a line leads to names that are farther away
DIRECTIONS = [(math.cos(turn), math.sin(turn)) for turn in (np.arange(24) + 2) * math.pi / 12]


@dataclass
class Mark:
    """A mean at (x, y) in data units, with the standard deviation of y (NaN: no bar) and the name to write beside it.

    movable: whether it may be drawn beside x. shift: how far it is drawn to the right of x, in points.
    """

    ax: Axes
    x: float
    y: float
    spread: float = math.nan
    name: str = ""
    movable: bool = True
    artists: list[Any] = field(default_factory=list)
    shift: float = 0.0

    def draw(self, marker: str, **look: Any) -> "Mark":
        """Draws the mark and its bar. look: as for `Axes.scatter`."""
        if math.isfinite(self.spread):
            bar = {"ecolor": look.get("color", style.ink()), "elinewidth": 0.7, "capsize": 1.5, "zorder": 2}
            self.artists += [part for group in self._bars(**bar) for part in group]
        self.artists.append(self.ax.scatter([self.x], [self.y], s=26, marker=marker, zorder=3, **look))
        return self

    def _bars(self, **look: Any) -> Sequence[Any]:
        _, caps, bars = self.ax.errorbar([self.x], [self.y], [self.spread], fmt="none", **look)
        return caps, bars

    def middle(self) -> np.ndarray:
        """Where the mark is drawn, (x, y) in points."""
        at = self.ax.transData.transform((self.x, self.y)) * _points(self.ax)
        return np.array([at[0] + self.shift, at[1]])

    def box(self, whole: bool = True) -> np.ndarray:
        """Left, low, right and high end in points, of mark and bar or of the mark alone."""
        x, _ = self.middle()
        spread = self.spread if whole and math.isfinite(self.spread) else 0.0
        ends = self.ax.transData.transform([(self.x, self.y - spread), (self.x, self.y + spread)])[:, 1]
        low, high = ends * _points(self.ax)
        return np.array([x - RADIUS, low - RADIUS, x + RADIUS, high + RADIUS])

    def move(self, shift: float) -> None:
        """Draws the mark and its bar `shift` points to the right of x."""
        self.shift = shift
        moved = self.ax.transData + ScaledTranslation(shift / 72, 0, self.ax.figure.dpi_scale_trans)
        *bars, mark = self.artists
        mark.set_offset_transform(moved)
        for bar in bars:
            bar.set_transform(moved)


def arrange(figure: Figure, marks: Sequence[Mark], lines: Sequence[tuple[Axes, np.ndarray]] = ()) -> None:
    """Moves marks apart and writes their names. The footnote counts the marks whose names find no room.

    Everything else of the figure must be drawn. lines: (n, 2) data that names should not cover, for each axes.
    """
    style.make_plain(figure)
    figure.draw_without_rendering()  # the layout decides how large the panels are
    unnamed = []
    for ax in dict.fromkeys(mark.ax for mark in marks):
        own = [mark for mark in marks if mark.ax is ax]
        _move_apart(own)
        covered = [_along(ax.transData.transform(line) * _points(ax)) for other, line in lines if other is ax]
        unnamed += _name(ax, own, np.concatenate([np.empty((0, 4)), *covered]))
    moved = any(mark.shift for mark in marks)
    notes = [
        f"marks that would cover each other stand up to {ASIDE:g} points aside" if moved else "",
        f"marks without room for a name: {len(unnamed)}" if unnamed else "",
    ]
    if any(notes):
        style.footnote(figure, " ".join(figure.get_supxlabel().split("\n")), *notes)


def _points(ax: Axes) -> float:
    return 72 / float(ax.figure.dpi)


def _inside(ax: Axes) -> np.ndarray:
    return np.array(ax.get_window_extent().extents) * _points(ax)


def _move_apart(marks: Sequence[Mark]) -> None:
    """Shifts each mark by as little as needed, to the right or left, so that no bar lies over another mark."""
    steps = sorted(np.arange(-ASIDE, ASIDE + 1, BARS / 2).tolist(), key=abs)
    done: list[tuple[np.ndarray, np.ndarray]] = []
    for mark in sorted(marks, key=lambda mark: (mark.x, -mark.y)):
        left, _, right, _ = _inside(mark.ax)
        free = () if not mark.movable else (shift for shift in steps if _is_free(mark, shift, done, left, right))
        mark.shift = next(iter(free), 0.0)
        done.append((mark.middle(), mark.box()))
        if mark.shift:
            mark.move(mark.shift)


def _is_free(
    mark: Mark, shift: float, done: Sequence[tuple[np.ndarray, np.ndarray]], left: float, right: float
) -> bool:
    mark.shift = shift
    x, y = mark.middle()
    _, low, _, high = mark.box()
    for (other_x, other_y), box in done:
        needed = MARKS if abs(y - other_y) < MARKS else BARS
        if abs(x - other_x) < needed and low < box[3] and box[1] < high:
            return False
    return bool(left + RADIUS < x < right - RADIUS)


def _name(ax: Axes, marks: Sequence[Mark], lines: np.ndarray) -> list[Mark]:
    """Writes the names of crowded marks first. Names cover nothing; lines that lead to them may cross bars."""
    middles = [mark.middle() for mark in marks]
    crowd = [sum(math.dist(one, other) < 40 for other in middles) for one in middles]
    drawn, named = [mark.box() for mark in marks], [mark.box(whole=False) for mark in marks]
    unnamed = []
    for number in sorted(range(len(marks)), key=lambda number: -crowd[number]):
        mark, name = marks[number], printable(marks[number].name)
        if not name:
            continue
        size = np.array([style.text_width(name, style.MARK) + 2, 1.15 * style.MARK])
        others = np.array([*named[:number], *named[number + 1 :], np.full(4, -np.inf)])
        found = _room(middles[number], size, _inside(ax), np.array(drawn + named[len(marks) :]), others, lines)
        if found is None:
            unnamed.append(mark)
            continue
        center, leader = found
        named += [np.concatenate([center - size / 2, center + size / 2]), *leader]
        _write(mark, name, center - middles[number], leads=len(leader) > 0)
    return unnamed


def _room(
    at: np.ndarray, size: np.ndarray, inside: np.ndarray, drawn: np.ndarray, others: np.ndarray, lines: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Middle of the nearest free box of this size, and boxes (n, 4) along the line to it where it is far away.

    The box covers nothing that is drawn, and if possible no lines; the line covers no other marks and names.
    """
    second = None
    for distance in DISTANCES:
        for direction in DIRECTIONS:
            center = at + np.array(direction) * (distance + size / 2)
            box = np.concatenate([center - size / 2, center + size / 2])
            near = np.clip(at, box[:2], box[2:])
            leader = _along(np.array([at, near])) if distance > BESIDE_MARK else np.empty((0, 4))
            within = (box[:2] >= inside[:2]).all() and (box[2:] <= inside[2:]).all()
            if within and not _covers(box, drawn) and not any(_covers(part, others) for part in leader):
                if not _covers(box, lines):
                    return center, leader
                second = second or (center, leader)
        if second is not None:
            return second
    return None


def _covers(box: np.ndarray, others: np.ndarray) -> bool:
    return bool(((box[:2] < others[:, 2:]) & (others[:, :2] < box[2:])).all(axis=1).any())


def _along(line: np.ndarray) -> np.ndarray:
    """Small boxes (n, 4) every two points along a polyline (n, 2)."""
    parts = [np.empty((0, 2))]
    for start, end in itertools.pairwise(line):
        parts.append(np.linspace(start, end, max(2, int(math.dist(start, end) / 2))))
    middles = np.concatenate(parts)
    return np.concatenate([middles - 1, middles + 1], axis=1)


def _write(mark: Mark, name: str, offset: np.ndarray, leads: bool) -> None:
    move = ScaledTranslation(mark.shift / 72, 0, mark.ax.figure.dpi_scale_trans)
    arrow = {"arrowstyle": "-", "lw": 0.4, "color": style.ink(), "alpha": 0.7, "shrinkA": 0, "shrinkB": RADIUS}
    mark.ax.annotate(
        name,
        (mark.x, mark.y),
        tuple(offset),
        xycoords=mark.ax.transData + move,
        textcoords="offset points",
        ha="center",
        va="center",
        fontsize=style.MARK,
        arrowprops=arrow if leads else None,
        annotation_clip=False,
        zorder=4,
    ).set_in_layout(False)
