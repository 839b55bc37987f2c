"""How many cameras see a point: a compiled CPU loop and its plain PyTorch reference."""

import numpy as np
import torch
from torch import Tensor

from qnerf.kernels.dispatch import serves
from qnerf.kernels.jit import jit, run

GRAIN = 4096  # points that are worth waking a thread for


def count_views(points: Tensor, matrices: Tensor, width: int, height: int, max_views: int) -> Tensor:
    """In how many images each world point falls, at most `max_views`: (N,) int64.

    Args:
        points: (N, 3) float64, world units.
        matrices: (V, 3, 4) float64, world -> (x depth, y depth, depth) with x, y in pixels and depth in world units.
        width, height: of the images, in pixels; their borders belong to them.
        max_views: where counting stops.
    """
    if not serves("counting views", points, matrices):
        return count_views_reference(points, matrices, width, height, max_views)
    counts = torch.empty(len(points), dtype=torch.int64)
    arrays = (points.contiguous().numpy(), matrices.contiguous().numpy(), width, height, max_views, counts.numpy())
    run(_count, len(points), *arrays, grain=GRAIN)
    return counts


def count_views_reference(points: Tensor, matrices: Tensor, width: int, height: int, max_views: int) -> Tensor:
    """What `count_views` computes, in plain PyTorch, one view at a time."""
    counts = torch.zeros(points.shape[0], dtype=torch.int64, device=points.device)
    for matrix in matrices:
        x, y, depth = (points @ matrix[:, :3].T + matrix[:, 3]).unbind(-1)
        counts += (depth > 0) & (x >= 0) & (x <= width * depth) & (y >= 0) & (y <= height * depth)
    return counts.clamp_(max=max_views)


@jit
def _count(start, stop, points, matrices, width, height, max_views, out):  # type: ignore[no-untyped-def]
    """Writes the counts of points start..stop."""
    # Point by point over the views, because counting stops as soon as enough of them see the point. The division by the
    # depth is left out: x <= width depth where the depth is above 0.
    for i in range(start, stop):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        count = np.int64(0)
        for v in range(matrices.shape[0]):
            m = matrices[v]
            depth = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
            if depth > 0:
                x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]
                y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]
                if x >= 0 and x <= width * depth and y >= 0 and y <= height * depth:
                    count += 1
                    if count == max_views:
                        break
        out[i] = count
