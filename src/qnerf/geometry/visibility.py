"""Where density may be: space that too few training cameras see cannot be reconstructed and is kept empty."""

import torch
from torch import Tensor, nn

from qnerf.geometry.contraction import Contraction
from qnerf.kernels.projection import count_views
from qnerf.scenes import Cameras


class SpaceMask(nn.Module):
    """Unit-cube points (..., 3) -> whether density may be there (...); points outside count to the nearest cell.

    Args:
        grid: (n, n, n) bool over the unit cube.
    """

    grid: Tensor

    def __init__(self, grid: Tensor) -> None:
        super().__init__()
        self.register_buffer("grid", grid, persistent=False)

    @property
    def fraction(self) -> float:
        """Share of contracted space in which density may be."""
        return float(self.grid.double().mean())

    @torch.no_grad()
    def forward(self, points: Tensor) -> Tensor:
        n = self.grid.shape[0]
        cell = (points * n).long().clamp_(0, n - 1)
        return self.grid.view(-1)[(cell[..., 0] * n + cell[..., 1]) * n + cell[..., 2]]


def visible(contraction: Contraction, cameras: Cameras, views: list[int], least: int, resolution: int) -> Tensor:
    """The grid (n, n, n) bool of contracted space that is true where at least `least` of the views see a cell.

    It is counted once from the poses: a camera sees a cell when the cell's centre projects inside its image, in front
    of it (lens distortion moves the border by a fraction of a cell and is left out). Few views see little in common, so
    at most half of them are asked for. ValueError where nothing is seen.
    """
    least = min(least, max(1, len(views) // 2))
    counts = count_cameras(contraction.inverse(cell_centres(resolution)), cameras, views, most=least)
    seen = counts >= least
    if not bool(seen.any()):
        raise ValueError(
            f"visibility.cameras: no cell is seen by {least} of {len(views)} training cameras "
            f"(at most {int(counts.max())} see one); lower it, or 0 turns it off"
        )
    return seen.view(resolution, resolution, resolution)


def cell_centres(resolution: int) -> Tensor:
    """Centres (n^3, 3) float64 of the unit cube's cells, row by row."""
    axis = (torch.arange(resolution, dtype=torch.float64) + 0.5) / resolution
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3)


def count_cameras(points: Tensor, cameras: Cameras, views: list[int], most: int | None = None) -> Tensor:
    """How many of the views have the world points (N, 3) in front of them and inside their image: (N,), at most `most`.

    Lens distortion is left out.
    """
    poses, (fx, fy, cx, cy) = cameras.poses[views], (cameras.intrinsics[views, i, None] for i in range(4))
    right, up, backward = poses[:, :, 0], poses[:, :, 1], poses[:, :, 2]
    turned = torch.stack([fx * right - cx * backward, -fy * up - cy * backward, -backward], dim=1)
    matrices = torch.cat([turned, -(turned @ poses[:, :, 3:])], dim=-1)
    limit = len(views) if most is None else most
    return count_views(points.to(torch.float64), matrices, cameras.width, cameras.height, limit)
