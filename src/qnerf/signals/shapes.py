"""Exact signed distances of shapes in the unit cube: negative inside, in sides of the cube, float64."""

import functools
from collections.abc import Callable

import numpy as np
import skimage.data
import skimage.measure  # loads its parts, and SciPy's statistics with them, when one is used
from numpy.typing import NDArray

SEMI_AXES = (0.42, 0.28, 0.16)
MARGIN = 0.1  # of the unit square around the polygon
TOLERANCE = 1.0  # pixels of the silhouette by which the polygon may leave its outline
PART = 4096  # points at a time


def ellipsoid(points: NDArray) -> NDArray:
    """Points (N, 3) -> distances (N,) of the ellipsoid with semi-axes `SEMI_AXES` around the middle of the cube.

    The closest point of the surface is e^2 p / (e^2 + t), with semi-axes e and p taken from the centre. Here t is the
    largest root of sum (e p / (e^2 + t))^2 = 1 (Eberly, "Distance from a Point to an Ellipse, an Ellipsoid, or a
    Hyperellipsoid"). It is found by bisection, to the last bits of float64, as its distance from the pole -min(e)^2,
    which it comes close to in the middle.

    >>> ellipsoid(np.array([[0.5, 0.5, 1.0], [0.5, 0.5, 0.5]])).round(12).tolist()
    [0.34, -0.16]
    """
    axes = np.array(SEMI_AXES)
    offset = np.maximum(np.abs(points - 0.5), 1e-14)  # by symmetry; on a plane of symmetry the root is a limit
    scaled, gap = axes * offset, axes**2 - axes.min() ** 2
    low = (scaled - gap).max(-1)  # one term alone is 1
    high = np.sqrt((scaled**2).sum(-1))  # all terms with the smallest denominator
    for _ in range(100):
        middle = (low + high) / 2
        above = ((scaled / (gap + middle[:, None])) ** 2).sum(-1) > 1
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    closest = axes * scaled / (gap + ((low + high) / 2)[:, None])
    inside = ((offset / axes) ** 2).sum(-1) < 1
    return np.where(inside, -1.0, 1.0) * np.sqrt(((offset - closest) ** 2).sum(-1))


def horse(points: NDArray) -> NDArray:
    """Points (N, 2), y down -> distances (N,) of the polygon `outline()`."""
    return np.concatenate(
        [polygon_distance(part, outline()) for part in np.array_split(points, -(-len(points) // PART))]
    )


@functools.cache
def outline() -> NDArray:
    """Corners (M, 2) of a closed polygon: scikit-image's silhouette of a horse, without its hole of 6 pixels, in
    the unit square."""
    silhouette = np.pad(~skimage.data.horse(), 1)
    longest = max(skimage.measure.find_contours(silhouette.astype(float), 0.5), key=len)
    corners = skimage.measure.approximate_polygon(longest, TOLERANCE)[:, ::-1]  # x, y
    low, high = corners.min(0), corners.max(0)
    return 0.5 + (corners - (low + high) / 2) * (1 - 2 * MARGIN) / (high - low).max()


def polygon_distance(points: NDArray, corners: NDArray) -> NDArray:
    """Points (N, 2) -> distances (N,) of the closed polygon with the corners (M, 2), the first one repeated at the end.

    >>> square = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0.0]])
    >>> polygon_distance(np.array([[0.5, 0.25], [2, 0.5]]), square).tolist()
    [-0.25, 1.0]
    """
    start, edge = corners[:-1], np.diff(corners, axis=0)
    offset = points[:, None] - start
    along = ((offset * edge).sum(-1) / (edge**2).sum(-1)).clip(0, 1)
    distance = np.sqrt(((offset - along[..., None] * edge) ** 2).sum(-1)).min(-1)
    return np.where(skimage.measure.points_in_poly(points, corners), -distance, distance)


SHAPES: dict[str, tuple[int, Callable[[NDArray], NDArray]]] = {"ellipsoid": (3, ellipsoid), "horse": (2, horse)}
"""Name -> number of coordinates, and points (N, D) -> distances (N,)."""
