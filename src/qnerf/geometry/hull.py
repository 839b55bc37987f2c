"""Visual hull: space carving with the silhouettes of images that have a transparent background."""

import itertools

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from qnerf.geometry.contraction import Contraction
from qnerf.geometry.visibility import cell_centres
from qnerf.scenes import Scene

MARGIN = 1 + 2**0.5  # pixels between centres: one pixel around the silhouette, and half a diagonal at either end


def visual_hull(contraction: Contraction, scene: Scene, resolution: int) -> Tensor:
    """The cells (n, n, n) bool of the unit cube that no training view proves empty.

    A view proves a cell empty if the cell's bounding sphere is in front of the camera, projects inside the image, and
    covers only transparent pixels, with a margin of one pixel.

    Raises:
        ValueError: the images have no alpha, the lens has distortion, or no cell is left.
    """
    if not scene.has_alpha:
        raise ValueError(
            f"visibility.alpha: the images of scene {scene.name} have no alpha; use visibility.alpha=false"
        )
    if not scene.cameras.straight:
        raise ValueError(
            f"visibility.alpha: the images of scene {scene.name} have lens distortion, which silhouettes do not "
            "support; undistort them, or use visibility.alpha=false"
        )
    cells = carve(scene, *bounding_spheres(contraction, resolution))
    if not bool(cells.any()):
        raise ValueError(
            f"visibility.alpha: the silhouettes of scene {scene.name} leave no space; "
            "use visibility.alpha=false, or check poses and alpha"
        )
    return cells.view(resolution, resolution, resolution)


def carve(scene: Scene, points: Tensor, radius: Tensor) -> Tensor:
    """Which spheres (N, 3), (N,), world units, no training view sees through: (N,) bool, possibly none."""
    remaining = torch.ones(len(points), dtype=torch.bool)
    for view in scene.train:
        index = remaining.nonzero()[:, 0]
        remaining[index] = ~sees_through(scene, view, points[index], radius[index])
    return remaining


def bounding_spheres(contraction: Contraction, resolution: int) -> tuple[Tensor, Tensor]:
    """Bounding spheres of the grid's cells, row by row: centres (N, 3) and radii (N,) in world units."""
    unit = cell_centres(resolution)
    points = contraction.inverse(unit)
    radius = torch.zeros(len(points), dtype=points.dtype)
    for signs in itertools.product((-1.0, 1.0), repeat=3):
        corner = contraction.inverse(unit + 0.5 / resolution * unit.new_tensor(signs))
        radius = torch.maximum(radius, torch.linalg.vector_norm(corner - points, dim=-1))
    return points, radius


def project_spheres(scene: Scene, view: int, points: Tensor, radius: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Projects spheres (N, 3), (N,), world units, to a view's image.

    Returns:
        x, y and radius in pixels, and whether the sphere is in front of the camera and inside the image; each (N,).
    """
    cameras = scene.cameras
    width, height = cameras.size(view)
    pose, focal = cameras.poses[view], torch.maximum(cameras.fx[view], cameras.fy[view])
    local = (points - pose[:, 3]) @ pose[:, :3]
    depth = -local[:, 2]
    x = cameras.fx[view] * local[:, 0] / depth + cameras.cx[view]
    y = -cameras.fy[view] * local[:, 1] / depth + cameras.cy[view]
    # An upper bound on the image of the radius: off the axis, a sphere projects to an ellipse.
    slant = torch.linalg.vector_norm(local, dim=-1) / depth
    size = focal * slant * radius / (depth - radius)
    inside = (x >= size) & (x <= width - size) & (y >= size) & (y <= height - size)
    return x, y, size, inside & (depth > radius)


def sees_through(scene: Scene, view: int, points: Tensor, radius: Tensor) -> Tensor:
    """Whether all pixels of the view that show a sphere (N, 3), (N,), world units, are transparent: (N,) bool."""
    solid = scene.image(view)[:, :, 3].numpy() > 0
    valid = scene.valid(view)
    if valid is not None:  # behind a mask may be anything
        solid |= ~valid.numpy()
    if solid.all():
        return torch.zeros(len(points), dtype=torch.bool)
    x, y, size, inside = project_spheres(scene, view, points, radius)
    # Distance in pixels to the nearest pixel that is not transparent.
    distance = distance_transform_edt(~solid) if solid.any() else np.full(solid.shape, np.inf)
    column = x.nan_to_num(0).clamp(0, solid.shape[1] - 1).long()
    row = y.nan_to_num(0).clamp(0, solid.shape[0] - 1).long()
    clear = torch.from_numpy(distance)[row, column] - MARGIN
    return inside & (clear > size)
