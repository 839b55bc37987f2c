"""Where density may be: space that too few training cameras see cannot be reconstructed and stays empty."""

import math

import torch
from torch import Tensor, nn

from qnerf.geometry.contraction import Contraction
from qnerf.geometry.rays import project, spread_rays
from qnerf.kernels.jit import one_torch_thread
from qnerf.scenes import Cameras, Scene

RAYS, SAMPLES, REACH = 1000, 400, 8.0
"""Rays that are followed, samples on each, and world units behind `near` where they end at the latest."""
CHUNK = 2**12  # points at a time: what is computed of them for `VIEWS` views stays in the caches
VIEWS = 8


class SpaceMask(nn.Module):
    """Unit-cube points (..., 3) -> whether density may be there: (...) bool. Points outside use the nearest cell.

    Args:
        grid: (n, n, n) bool over the unit cube.
    """

    grid: Tensor

    def __init__(self, grid: Tensor) -> None:
        super().__init__()
        self.register_buffer("grid", grid, persistent=False)

    @torch.no_grad()
    def forward(self, points: Tensor) -> Tensor:
        n = self.grid.shape[0]
        cell = (points * n).nan_to_num(nan=0.0).clamp_(0, n - 1).long()
        return self.grid.view(-1)[(cell[..., 0] * n + cell[..., 1]) * n + cell[..., 2]]


def visible_cells(
    contraction: Contraction, cameras: Cameras, views: list[int], min_views: int, resolution: int
) -> Tensor:
    """The cells (n, n, n) bool of contracted space that at least `min_views` of the views see.

    A camera sees a cell if the cell's centre projects inside its image, in front of it. Lens distortion is ignored: it
    moves the border by a fraction of a cell. `min_views` is limited to half of the views.

    Raises:
        ValueError: no cell is seen by enough views.
    """
    min_views = min(min_views, max(1, len(views) // 2))
    counts = count_cameras(contraction.inverse(cell_centres(resolution)), cameras, views, limit=min_views)
    cells = counts >= min_views
    if not bool(cells.any()):
        raise ValueError(
            f"visibility.cameras: no cell is seen by {min_views} of {len(views)} training cameras "
            f"(at most {int(counts.max())} see one); lower it, or 0 turns it off"
        )
    return cells.view(resolution, resolution, resolution)


def cell_centres(resolution: int) -> Tensor:
    """Centres (n^3, 3) float64 of the unit cube's cells, row by row."""
    axis = (torch.arange(resolution, dtype=torch.float64) + 0.5) / resolution
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3)


def count_cameras(points: Tensor, cameras: Cameras, views: list[int], limit: int | None = None) -> Tensor:
    """In how many of the views each world point (N, 3) is visible: (N,), counted up to `limit`.

    Visible means in front of the camera and inside the image; occlusion and the distortion of a perspective lens are
    ignored.
    """
    limit = len(views) if limit is None else limit
    bent = [view for view in views if cameras.fisheye is not None and cameras.fisheye[view]]
    counts = torch.zeros(len(points), dtype=torch.int64)
    for view in bent:
        pixels, depth = project(cameras, torch.full((len(points),), view), points)
        counts += (depth > 0) & (pixels >= 0).all(1) & (pixels <= cameras.all_sizes[view]).all(1)
    straight = torch.tensor(sorted(set(views) - set(bent)), dtype=torch.int64)
    for width, height in dict.fromkeys(map(tuple, cameras.all_sizes[straight].tolist())):
        alike = straight[(cameras.all_sizes[straight] == torch.tensor([width, height])).all(1)]
        counts += count_views(points.to(torch.float64), projections(cameras, alike), width, height, limit)
    return counts.clamp_(max=limit)


def count_views(points: Tensor, matrices: Tensor, width: int, height: int, limit: int) -> Tensor:
    """In how many images of `width` x `height` pixels each world point (N, 3) falls: (N,), exact up to `limit`.

    Their borders belong to the images. `matrices` (V, 3, 4) are those of `projections`.
    """
    counts = torch.zeros(len(points), dtype=torch.int64)
    with one_torch_thread():
        for part, count in zip(points.split(CHUNK), counts.split(CHUNK), strict=True):
            for some in matrices.split(VIEWS):
                x, y, depth = (some[:, :, :3] @ part.T + some[:, :, 3:]).unbind(1)
                inside = (depth > 0) & (x >= 0) & (x <= width * depth) & (y >= 0) & (y <= height * depth)
                count += inside.sum(0)
                if int(count.min()) >= limit:
                    break
    return counts


def projections(cameras: Cameras, views: Tensor) -> Tensor:
    """(V, 3, 4) of pinholes: world -> (x depth, y depth, depth), with x, y in pixels and depth in world units."""
    poses, (fx, fy, cx, cy) = cameras.poses[views], (cameras.intrinsics[views, i, None] for i in range(4))
    right, up, backward = poses[:, :, 0], poses[:, :, 1], poses[:, :, 2]
    rotations = torch.stack([fx * right - cx * backward, -fy * up - cy * backward, -backward], dim=1)
    return torch.cat([rotations, -(rotations @ poses[:, :, 3:])], dim=-1)


@torch.no_grad()
def crossed(scene: Scene, contraction: Contraction, mask: SpaceMask | None, near: float, far: float) -> float:
    """World units of space where density may be along a training ray: three quarters of those that meet any meet more.

    Rays are followed for at most `REACH` world units. Infinity if none of them meets any.

    mask: where density may be; None: everywhere between near and far.
    """
    length = min(far - near, REACH)
    if mask is None:
        return length
    rays = spread_rays(scene, RAYS)
    distances = near + length * (torch.arange(SAMPLES, dtype=torch.float64) + 0.5) / SAMPLES
    inside = mask(contraction(rays.origins[:, None] + rays.directions[:, None] * distances[:, None]))
    share = inside.double().mean(1)
    return length * float(share[share > 0].quantile(0.25)) if bool(inside.any()) else math.inf
