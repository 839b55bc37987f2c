"""What transparent pixels prove empty: the visual hull of an object on a transparent background."""

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from qnerf.contraction import Contraction
from qnerf.scenes import Scene


def hull(contraction: Contraction, scene: Scene, resolution: int) -> Tensor:
    """The grid (n, n, n) bool of the unit cube that is false where a training view looks through a cell.

    A view looks through a cell when the sphere around the cell falls on its image, in front of it, and touches nothing
    but transparent pixels, by a margin of a pixel. ValueError where the images have no alpha or nothing is left.
    """
    if scene.images.shape[-1] != 4:
        raise ValueError(
            f"visibility.alpha: the images of scene {scene.name} have no alpha; use visibility.alpha=false"
        )
    axis = (torch.arange(resolution, dtype=torch.float64) + 0.5) / resolution
    unit = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3)
    points = contraction.inverse(unit)
    half = 0.5 / resolution
    radius = torch.linalg.vector_norm(contraction.inverse(unit + half) - contraction.inverse(unit - half), dim=-1) / 2
    left = torch.ones(len(points), dtype=torch.bool)
    for view in scene.train:
        index = left.nonzero()[:, 0]
        left[index] = ~looks_through(scene, view, points[index], radius[index])
    if not bool(left.any()):
        raise ValueError(
            f"visibility.alpha: the silhouettes of scene {scene.name} leave no space at all; "
            "use visibility.alpha=false, or check poses and alpha"
        )
    return left.view(resolution, resolution, resolution)


def looks_through(scene: Scene, view: int, points: Tensor, radius: Tensor) -> Tensor:
    """Whether the view sees nothing in spheres (N, 3), (N,), world units."""
    cameras = scene.cameras
    pose = cameras.poses[view]
    local = (points - pose[:, 3]) @ pose[:, :3]
    depth = -local[:, 2]
    x = cameras.fx[view] * local[:, 0] / depth + cameras.cx[view]
    y = -cameras.fy[view] * local[:, 1] / depth + cameras.cy[view]
    inside = (depth > radius) & (x >= 0) & (x < cameras.width) & (y >= 0) & (y < cameras.height)
    solid = scene.images[view, :, :, 3].numpy() > 0
    if solid.all():
        return torch.zeros_like(inside)
    # Where nothing is solid the nearest solid pixel is infinitely far.
    away = distance_transform_edt(~solid) if solid.any() else np.full(solid.shape, np.inf)
    column, row = (
        x.nan_to_num(0).long().clamp(0, cameras.width - 1),
        y.nan_to_num(0).long().clamp(0, cameras.height - 1),
    )
    clear = torch.from_numpy(away)[row, column] - 1.5  # a pixel of margin, half for the pixel's own extent
    size = torch.maximum(cameras.fx[view], cameras.fy[view]) * radius / (depth - radius).clamp(min=1e-9)
    return inside & (clear > size)
