"""Two samples of angles compared: Kuiper's test, Wasserstein distance and mean direction on the circle.

Angles are in turns, of any number: 0.25 and 1.25 are the same direction.
"""

from typing import TypeVar

import numpy as np

Angles = TypeVar("Angles", float, np.ndarray)


def kuiper(first: np.ndarray, second: np.ndarray) -> tuple[float, float]:
    """Kuiper's two-sample statistic V = max(F - G) + max(G - F), in [0, 1], and its asymptotic p-value.

    V does not depend on where the circle is cut open. p = 2 sum_j (4 j^2 l^2 - 1) exp(-2 j^2 l^2) with
    l = (sqrt(N) + 0.155 + 0.24 / sqrt(N)) V and N = n m / (n + m) (Kuiper 1960, "Tests concerning random points on a
    circle"; Stephens 1970, "Use of the Kolmogorov-Smirnov, Cramer-von Mises and related statistics without extensive
    tables"). NaN where a sample is empty.
    """
    if min(len(first), len(second)) == 0:
        return float("nan"), float("nan")
    _, gap = _gaps(first, second)
    statistic = float(max(gap.max(), 0.0) + max(-gap.min(), 0.0))
    root = np.sqrt(len(first) * len(second) / (len(first) + len(second)))
    scale = (root + 0.155 + 0.24 / root) * statistic
    if scale < 0.4:  # the series converges slowly and its sum is 1 to seven digits
        return statistic, 1.0
    squares = (np.arange(1, 101) * scale) ** 2
    return statistic, float(np.clip(2 * np.sum((4 * squares - 1) * np.exp(-2 * squares)), 0, 1))


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
