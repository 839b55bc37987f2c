"""Two samples of angles compared: Wasserstein distance and mean direction on the circle.

Angles are in turns, of any number: 0.25 and 1.25 are the same direction.
"""

from typing import TypeVar

import numpy as np

Angles = TypeVar("Angles", float, np.ndarray)


def wasserstein(first: np.ndarray, second: np.ndarray) -> float:
    """First Wasserstein distance on the circle, turns in [0, 0.5]: the mean arc by which mass has to move.

    min over a of the integral of |F - G - a|, whose minimum is at a median of F - G (Rabin, Delon and Gousseau 2011,
    "Transportation distances on the circle"). NaN where a sample is empty.
    """
    if min(len(first), len(second)) == 0:
        return float("nan")
    points, gap = _gaps(first, second)
    arcs = np.diff(points, append=points[0] + 1)
    order = np.argsort(gap)
    median = gap[order][np.searchsorted(np.cumsum(arcs[order]), 0.5)]
    return float(np.sum(arcs * np.abs(gap - median)))


def mean_direction(angles: np.ndarray) -> float:
    """Direction of the sum of the unit vectors, turns in [0, 1); NaN for an empty sample."""
    return float(np.angle(np.exp(2j * np.pi * angles).sum()) / (2 * np.pi) % 1) if len(angles) else float("nan")


def turn(first: float, second: Angles) -> Angles:
    """The signed shorter way from one direction to the other, turns in [-0.5, 0.5)."""
    return (second - first + 0.5) % 1 - 0.5


def _gaps(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The distinct angles of both samples in ascending order, and F - G from each to the next."""
    first, second = np.sort(first % 1), np.sort(second % 1)
    points = np.unique(np.concatenate([first, second]))
    f, g = (np.searchsorted(sample, points, side="right") / len(sample) for sample in (first, second))
    return points, f - g
