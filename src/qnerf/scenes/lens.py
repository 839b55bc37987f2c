"""OpenCV's lens model, radial k1, k2 and tangential p1, p2, and its inverse.

Image-plane points are in focal lengths from the principal point, x to the right and y down.
"""

import torch
from torch import Tensor

ITERATIONS = 10
TOLERANCE = 1e-9  # of the distorted point, in focal lengths


def distort(points: Tensor, distortion: Tensor) -> Tensor:
    """Ideal image-plane points (..., 2) -> distorted points (..., 2).

    x' = x (1 + k1 r^2 + k2 r^4) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4) + p1 (r^2 + 2 y^2) + 2 p2 x y

    >>> distort(torch.tensor([0.5, 0.0]), torch.tensor([0.1, 0, 0, 0]))
    tensor([0.5125, 0.0000])

    Args:
        distortion: k1 k2 p1 p2 (..., 4), broadcast over the points.
    """
    return _distort(points, distortion)[0]


def _distort(points: Tensor, distortion: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The distorted points and their derivatives: (x', y'), dx'/dx, dx'/dy = dy'/dx, dy'/dy."""
    x, y = points.unbind(-1)
    k1, k2, p1, p2 = distortion.unbind(-1)
    square = x * x + y * y
    radial = 1 + square * (k1 + square * k2)
    slope = 2 * (k1 + 2 * square * k2)  # d radial / dx = slope x
    moved = torch.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        ],
        dim=-1,
    )
    xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    xy = slope * x * y + 2 * p1 * x + 2 * p2 * y
    return moved, xx, xy, yy


def undistort(points: Tensor, distortion: Tensor) -> Tensor:
    """Distorted points (..., 2) -> ideal image-plane points (..., 2), by ten steps of Newton's method.

    `invertible` says whether the result is the inverse.
    """
    ideal = points
    for _ in range(ITERATIONS):
        moved, xx, xy, yy = _distort(ideal, distortion)
        dx, dy = (moved - points).unbind(-1)
        determinant = xx * yy - xy * xy
        safe = torch.where(determinant.abs() > 1e-12, determinant, torch.full_like(determinant, float("inf")))
        ideal = ideal - torch.stack([yy * dx - xy * dy, xx * dy - xy * dx], dim=-1) / safe[..., None]
    return ideal


def invertible(points: Tensor, distortion: Tensor) -> Tensor:
    """Whether `undistort` finds the unique inverse of each point (..., 2): (...) bool.

    Newton's method must converge, and the lens must not fold the image over between the principal point and the point.
    """
    ideal = undistort(points, distortion)
    moved = distort(ideal, distortion)
    good = ((moved - points).abs() <= TOLERANCE * (1 + points.abs())).all(-1)
    for fraction in torch.linspace(0, 1, 17, dtype=torch.float64).tolist():
        _, xx, xy, yy = _distort(ideal * fraction, distortion)
        good &= (xx * yy - xy * xy > 0) & (xx + yy > 0)
    return good
