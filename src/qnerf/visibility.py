"""Where the training cameras see: space that too few of them see cannot be reconstructed and is kept empty."""

import torch
from torch import Tensor, nn

from qnerf.contraction import Contraction
from qnerf.scenes import Cameras


class VisibilityGrid(nn.Module):
    """World points (..., 3) -> 1 where enough training cameras see the cell, else 0 (...).

    The grid lies in contracted space and is counted once from the poses: a camera sees a cell when the cell's centre
    projects inside its image at a distance of at least `near` (lens distortion moves the border by a fraction of a
    cell and is left out).
    """

    grid: Tensor

    def __init__(
        self, contraction: Contraction, cameras: Cameras, views: list[int], least: int, resolution: int
    ) -> None:
        super().__init__()
        self.contraction = contraction
        self.resolution = resolution
        axis = (torch.arange(resolution, dtype=torch.float64) + 0.5) / resolution
        cells = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3)
        # Few views see little in common: half of them is enough.
        least = min(least, max(1, len(views) // 2))
        counts = count_cameras(contraction.inverse(cells), cameras, views)
        seen = counts >= least
        if not bool(seen.any()):
            raise ValueError(
                f"visibility.cameras: no cell is seen by {least} of {len(views)} training cameras "
                f"(at most {int(counts.max())} see one); lower it, or 0 turns it off"
            )
        self.register_buffer("grid", seen.to(torch.get_default_dtype()), persistent=False)

    @property
    def fraction(self) -> float:
        """Share of contracted space in which density may be."""
        return float(self.grid.mean())

    @torch.no_grad()
    def forward(self, points: Tensor) -> Tensor:
        n = self.resolution
        cell = (self.contraction(points) * n).long().clamp_(0, n - 1)
        return self.grid[(cell[..., 0] * n + cell[..., 1]) * n + cell[..., 2]]


def count_cameras(points: Tensor, cameras: Cameras, views: list[int]) -> Tensor:
    """How many of the views have the world points (N, 3) in front of them and inside their image: (N,)."""
    counts = torch.zeros(points.shape[0], dtype=torch.int64)
    for view in views:
        pose = cameras.poses[view].to(points.dtype)
        local = (points - pose[:, 3]) @ pose[:, :3]
        depth = -local[:, 2]
        x = cameras.fx[view] * local[:, 0] / depth + cameras.cx[view]
        y = -cameras.fy[view] * local[:, 1] / depth + cameras.cy[view]
        counts += (depth > 0) & (x >= 0) & (x <= cameras.width) & (y >= 0) & (y <= cameras.height)
    return counts
