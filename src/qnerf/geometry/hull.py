"""What transparent pixels prove empty: the visual hull of an object on a transparent background."""

import itertools

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from qnerf.geometry.contraction import Contraction
from qnerf.geometry.visibility import cell_centres
from qnerf.scenes import Scene

MARGIN = 1 + 2**0.5  # pixels between centres: one that is kept around what is solid, and half a diagonal of each


def hull(contraction: Contraction, scene: Scene, resolution: int) -> Tensor:
    """The grid (n, n, n) bool of the unit cube that is false where a training view looks through a cell.

    A view looks through a cell when the sphere around the cell falls on its image, in front of it, and touches nothing
    but transparent pixels, by a margin of a pixel. ValueError where the images have no alpha, or a lens distortion, or
    nothing is left.
    """
    if scene.images.shape[-1] != 4:
        raise ValueError(
            f"visibility.alpha: the images of scene {scene.name} have no alpha; use visibility.alpha=false"
        )
    if bool(scene.cameras.distortion.any()):
        raise ValueError(
            f"visibility.alpha: the images of scene {scene.name} have a lens distortion, which silhouettes are not "
            "freed of; undistort them, or use visibility.alpha=false"
        )
    left = carved(scene, *spheres(contraction, resolution))
    if not bool(left.any()):
        raise ValueError(
            f"visibility.alpha: the silhouettes of scene {scene.name} leave no space at all; "
            "use visibility.alpha=false, or check poses and alpha"
        )
    return left.view(resolution, resolution, resolution)


def carved(scene: Scene, points: Tensor, radius: Tensor) -> Tensor:
    """Which spheres (N, 3), (N,), world units, no training view looks through (N,); maybe none."""
    left = torch.ones(len(points), dtype=torch.bool)
    for view in scene.train:
        index = left.nonzero()[:, 0]
        left[index] = ~looks_through(scene, view, points[index], radius[index])
    return left


def spheres(contraction: Contraction, resolution: int) -> tuple[Tensor, Tensor]:
    """Around each of the grid's cells, row by row: centres (N, 3) and radii (N,) in world units."""
    unit = cell_centres(resolution)
    points = contraction.inverse(unit)
    radius = torch.zeros(len(points), dtype=points.dtype)
    for signs in itertools.product((-1.0, 1.0), repeat=3):
        corner = contraction.inverse(unit + 0.5 / resolution * unit.new_tensor(signs))
        radius = torch.maximum(radius, torch.linalg.vector_norm(corner - points, dim=-1))
    return points, radius


def seen(scene: Scene, view: int, points: Tensor, radius: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Spheres (N, 3), (N,), world units, on a view's image: x, y and size in pixels, and whether they are wholly on it,
    in front of the camera, each (N,)."""
    cameras = scene.cameras
    pose, focal = cameras.poses[view], torch.maximum(cameras.fx[view], cameras.fy[view])
    local = (points - pose[:, 3]) @ pose[:, :3]
    depth = -local[:, 2]
    x = cameras.fx[view] * local[:, 0] / depth + cameras.cx[view]
    y = -cameras.fy[view] * local[:, 1] / depth + cameras.cy[view]
    # A step of length r moves a point at depth z by at most this; a sphere off the axis is seen as a longer ellipse.
    slant = torch.linalg.vector_norm(local, dim=-1) / depth
    size = focal * slant * radius / (depth - radius)
    whole = (x >= size) & (x <= cameras.width - size) & (y >= size) & (y <= cameras.height - size)
    return x, y, size, whole & (depth > radius)


def looks_through(scene: Scene, view: int, points: Tensor, radius: Tensor) -> Tensor:
    """Whether the view sees nothing in spheres (N, 3), (N,), world units."""
    solid = scene.images[view, :, :, 3].numpy() > 0
    if solid.all():
        return torch.zeros(len(points), dtype=torch.bool)
    x, y, size, whole = seen(scene, view, points, radius)
    # Where nothing is solid the nearest solid pixel is infinitely far.
    away = distance_transform_edt(~solid) if solid.any() else np.full(solid.shape, np.inf)
    column = x.nan_to_num(0).clamp(0, solid.shape[1] - 1).long()
    row = y.nan_to_num(0).clamp(0, solid.shape[0] - 1).long()
    clear = torch.from_numpy(away)[row, column] - MARGIN
    return whole & (clear > size)
