"""OpenCV's lens models and their inverses: perspective with k1 k2 p1 p2, and fisheye with k1 k2 k3 k4.

Image-plane points are in focal lengths from the principal point, x to the right and y down. A fisheye's ideal points
are as far from the centre as their angle to the optical axis, in radians.
"""

import math

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


def fisheye_distort(points: Tensor, distortion: Tensor) -> Tensor:
    """Ideal fisheye points (..., 2), whose length is an angle t in radians -> distorted points (..., 2).

    Their length becomes t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8).

    Args:
        distortion: k1 k2 k3 k4 (..., 4), broadcast over the points.
    """
    return points * _stretch(points.square().sum(-1), distortion)[0][..., None]


def fisheye_undistort(points: Tensor, distortion: Tensor) -> Tensor:
    """Distorted fisheye points (..., 2) -> ideal ones (..., 2), by ten steps of Newton's method on the angle."""
    length = torch.linalg.vector_norm(points, dim=-1)
    angle = length
    for _ in range(ITERATIONS):
        factor, slope = _stretch(angle.square(), distortion)
        angle = angle - (angle * factor - length) / torch.where(slope.abs() > 1e-12, slope, float("inf"))
    return points * torch.where(length > 0, angle / length.clamp(min=1e-300), 1.0)[..., None]


def _stretch(square: Tensor, distortion: Tensor) -> tuple[Tensor, Tensor]:
    """Distorted length over angle, and the derivative of the length by the angle, at squared angles."""
    k1, k2, k3, k4 = distortion.unbind(-1)
    factor = 1 + square * (k1 + square * (k2 + square * (k3 + square * k4)))
    slope = 1 + square * (3 * k1 + square * (5 * k2 + square * (7 * k3 + square * 9 * k4)))
    return factor, slope


def fisheye_invertible(points: Tensor, distortion: Tensor) -> Tensor:
    """Whether `fisheye_undistort` finds the one inverse of each point (..., 2), within pi of the axis: (...) bool."""
    ideal = fisheye_undistort(points, distortion)
    square = ideal.square().sum(-1)
    good = ((fisheye_distort(ideal, distortion) - points).abs() <= TOLERANCE * (1 + points.abs())).all(-1)
    good &= square <= math.pi**2
    for fraction in torch.linspace(0, 1, 17, dtype=torch.float64).tolist():
        good &= _stretch(square * fraction**2, distortion)[1] > 0
    return good


def directions(points: Tensor, distortion: Tensor, fisheye: Tensor | None = None) -> Tensor:
    """Distorted image-plane points (..., 2) -> unit directions (..., 3) in the camera's frame, OpenGL's axes.

    Args:
        distortion: (..., 4), broadcast over the points.
        fisheye: (...) bool, broadcast over the points: whether the lens is a fisheye; None: none is.
    """
    ideal = undistort(points, distortion)
    rays = torch.cat([ideal[..., :1], -ideal[..., 1:], -torch.ones_like(ideal[..., :1])], dim=-1)
    rays = rays / torch.linalg.vector_norm(rays, dim=-1, keepdim=True)
    if fisheye is None or not bool(fisheye.any()):
        return rays
    ideal = fisheye_undistort(points, distortion)
    angle = torch.linalg.vector_norm(ideal, dim=-1, keepdim=True)
    across = ideal * torch.sinc(angle / math.pi)
    bent = torch.cat([across[..., :1], -across[..., 1:], -angle.cos()], dim=-1)
    return torch.where(fisheye[..., None], bent, rays)


def image_points(local: Tensor, distortion: Tensor, fisheye: Tensor | None = None) -> Tensor:
    """The inverse of `directions`: points (..., 3) in the camera's frame -> distorted image-plane points (..., 2).

    Those of a perspective lens are valid only in front of the camera, where z is below 0.
    """
    plane = torch.stack([local[..., 0], -local[..., 1]], dim=-1)
    points = distort(plane / -local[..., 2:], distortion)
    if fisheye is None or not bool(fisheye.any()):
        return points
    across = torch.linalg.vector_norm(plane, dim=-1)
    angle = torch.atan2(across, -local[..., 2])
    bent = fisheye_distort(plane * (angle / across.clamp(min=1e-300))[..., None], distortion)
    return torch.where(fisheye[..., None], bent, points)
