"""The surface of a trained model as points where the training rays end.

Everything here is in normalised world units; `world` moves points into the coordinates of the scene's source.
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from qnerf.probes.trained import Trained
from qnerf.viewing.frames import Renderer, as_bytes
from qnerf.viewing.ply import Points

NEIGHBOURS = 16  # of a point, from which its normal is computed
ISOLATED = 4.0  # times the median distance to the neighbours, beyond which a point is dropped
OPAQUE = 0.5  # least opacity of a ray that ends on a surface
SLAB = 2**18  # points whose normals are computed at once
RAYS = 1_000_000  # of all training views together
WITHIN = 4.0  # world units


@dataclass(frozen=True)
class Hits:
    """Where N rays of training views end."""

    points: Tensor  # (N, 3)
    directions: Tensor  # (N, 3) of the rays, unit length
    colors: Tensor  # (N, 3) in [0, 1]


def ray_ends(renderer: Renderer, limit: int, within: float = WITHIN) -> Hits:
    """Where evenly spread rays of all training views end: at their median depth.

    limit: number of rays, at most, unless that is less than one a view. within: largest absolute coordinate that is
    kept; ValueError where no ray ends within.
    """
    trained = renderer.trained
    parts = []
    for view in trained.scene.train:
        seen = renderer.view(view, max(limit // len(trained.scene.train), 1))
        origins, directions = view_rays(renderer, view, seen.stride)
        points = origins + directions * seen.depth[..., None]
        kept = (seen.accumulation > OPAQUE) & (points.abs() <= within).all(-1)
        parts.append((points[kept], directions[kept], seen.color[kept]))
    hits = Hits(*map(torch.cat, zip(*parts, strict=True)))
    if not len(hits.points):
        raise ValueError(f"no ray of a training view ends within {within:g} world units; see --within")
    return hits


def view_rays(renderer: Renderer, view: int, stride: int) -> tuple[Tensor, Tensor]:
    """Origins and directions (H, W, 3) of the rays of `Renderer.view`, on the CPU."""
    rays = renderer.table.view(view, renderer.trained.model.cameras)
    height, width = renderer.evaluator.truth(view).shape[:2]
    grids = (rays.origins.detach().cpu(), rays.directions.detach().cpu())
    origins, directions = (grid.view(height, width, 3)[::stride, ::stride] for grid in grids)
    return origins, directions


def cloud(hits: Hits) -> Points:
    """The points without isolated ones, with normals: the least direction of each point's neighbours, towards its
    camera."""
    points = hits.points.double().numpy()
    count = min(NEIGHBOURS, len(points))
    distances, near = cKDTree(points).query(points, count, workers=-1)
    distances, near = distances.reshape(len(points), count), near.reshape(len(points), count)
    mean = distances.mean(1)
    kept = np.flatnonzero(mean <= ISOLATED * np.median(mean))
    normals = np.empty((len(kept), 3))
    for part in np.array_split(np.arange(len(kept)), max(1, len(kept) // SLAB)):
        around = points[near[kept[part]]]
        around = around - around.mean(1, keepdims=True)
        normals[part] = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, 0]
    away = (normals * hits.directions.numpy()[kept]).sum(1) > 0
    normals[away] *= -1
    return Points(points[kept], normals, as_bytes(hits.colors[torch.from_numpy(kept)]))


def world(trained: Trained, points: Points) -> Points:
    """The points in the coordinates of the scene's source, such as transforms.json."""
    return points.moved(np.linalg.inv(trained.scene.transform.numpy()))
