"""The surface of a trained model: points where the training rays end, and a mesh where the density passes a level.

Everything here is in normalised world units; `world` moves a surface into the coordinates of the scene's source.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from qnerf.config import memory
from qnerf.probes.trained import Trained
from qnerf.training.forecast import announced, seconds_each
from qnerf.viewing.frames import Renderer, as_bytes
from qnerf.viewing.ply import Surface

NEIGHBOURS = 16  # of a point, from which its normal is computed
ISOLATED = 4.0  # times the median distance to the neighbours, beyond which a point is dropped
OPAQUE = 0.5  # least opacity of a ray that ends on a surface
SLAB = 2**18  # positions whose density is computed at once
RAYS = 1_000_000  # of all training views together
WITHIN = 4.0  # world units
CELLS = 192
THICKNESS = 0.05  # of the grid's longest side, within which a surface absorbs half of the light


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


def cloud(hits: Hits) -> Surface:
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
    return Surface(points[kept], normals, as_bytes(hits.colors[torch.from_numpy(kept)]))


def mesh(
    renderer: Renderer,
    hits: Hits,
    cells: int = CELLS,
    level: float | None = None,
    tell: Callable[[str], None] = lambda line: None,
) -> Surface:
    """Marching cubes (Lorensen and Cline 1987, as scikit-image has them) on the logarithm of the density.

    The grid spans the points but for the outermost percent on each side. Only the triangles stay that training views
    see: behind a wall, where no ray gets, a field may hold anything.

    cells: of the grid along its longest side. level: density per world unit; None: half of the light is absorbed within
    a twentieth of the longest side. tell: takes the time of a long one before it starts.

    ValueError where the density passes the level nowhere, memory is too small, or it takes more than `run.hours`.
    """
    low, high = (np.percentile(hits.points.double().numpy(), share, axis=0) for share in (1, 99))
    margin = 0.05 * (high - low).max()
    low, high = low - margin, high + margin
    cell = float((high - low).max()) / cells
    shape = tuple(int(size) for size in np.ceil((high - low) / cell) + 1)
    what, fewer = f"a grid of {' x '.join(map(str, shape))}", "use fewer --cells"
    memory.require(what, 40 * math.prod(shape), hint=fewer)
    level = math.log(2) / (THICKNESS * cell * cells) if level is None else level
    field = renderer.trained.model.field

    def density(points: Tensor) -> Tensor:
        return field.density(points[:, None])[:, 0]

    some = hits.points[:SLAB].to(renderer.table.device, renderer.table.dtype)
    with torch.no_grad():
        seconds = math.prod(shape) * seconds_each(lambda few: density(some[:few]), len(some))
    if line := announced(what, seconds, renderer.trained.settings.run.hours, fewer):
        tell(line)
    grid = sampled(density, low, cell, shape, renderer)
    try:
        surface = marched(grid, low, cell, level)
    except ValueError:
        span = f"it lies between {grid.min():g} and {grid.max():g} there"
        raise ValueError(
            f"the density is {level:g} per world unit nowhere in the scene: {span}; set another --level"
        ) from None
    return seen(surface, hits, cell)


@torch.no_grad()
def sampled(
    density: Callable[[Tensor], Tensor], low: NDArray, cell: float, shape: tuple[int, ...], renderer: Renderer
) -> NDArray:
    """Densities float32 at the corners of a grid, computed in slabs."""
    table = renderer.table
    grid = np.empty(math.prod(shape), np.float32)
    for start in range(0, len(grid), SLAB):
        numbers = np.arange(start, min(start + SLAB, len(grid)))
        points = low + cell * np.stack(np.unravel_index(numbers, shape), axis=1)
        grid[numbers] = density(torch.from_numpy(points).to(table.device, table.dtype)).cpu().numpy()
    return grid.reshape(shape)


def marched(grid: NDArray, low: NDArray, cell: float, level: float) -> Surface:
    """The surface, without colours, where densities on a grid pass a level; ValueError where they do so nowhere."""
    from skimage.measure import marching_cubes

    logarithms = np.log(np.maximum(grid, 1e-6))
    points, faces, normals, _ = marching_cubes(
        logarithms, math.log(level), spacing=(cell,) * 3, gradient_direction="ascent"
    )
    return Surface(points + low, np.ascontiguousarray(normals), np.zeros(points.shape, np.uint8), faces)


def seen(surface: Surface, hits: Hits, tolerance: float) -> Surface:
    """The triangles whose corners are within `tolerance` of where training rays end, in the colours of the nearest."""
    assert surface.faces is not None
    apart, nearest = cKDTree(hits.points.double().numpy()).query(surface.points, workers=-1)
    faces = surface.faces[(apart <= tolerance)[surface.faces].all(1)]
    used, numbers = np.unique(faces, return_inverse=True)
    colors = as_bytes(hits.colors[torch.from_numpy(nearest[used])])
    return Surface(surface.points[used], surface.normals[used], colors, numbers.reshape(faces.shape))


def world(trained: Trained, surface: Surface) -> Surface:
    """The surface in the coordinates of the scene's source, such as transforms.json."""
    return surface.moved(np.linalg.inv(trained.scene.transform.numpy()))
