"""Whether a scene is bounded, and which part of a ray the training cameras see."""

import math

import torch

from qnerf.geometry.contraction import CONTRACTIONS
from qnerf.geometry.hull import bounding_spheres, carve, project_spheres
from qnerf.geometry.rays import spread_rays
from qnerf.geometry.visibility import count_cameras
from qnerf.scenes import Scene

CELLS = 48  # per axis of the grid that is carved
MAX_CAMERAS = 4
COVERED = 0.99  # share of training rays that must meet space seen by enough cameras
RAYS = 2000  # training rays to follow
MARGIN = 0.1  # share of the distance added in front of the nearest surface and behind the farthest


def box_half_extent(scene: Scene) -> float | None:
    """Half the side, in world units, of the cube around the origin that contains the object.

    The object is the space inside all silhouettes that at least half of the training cameras see completely. None
    without alpha, with lens distortion, if nothing remains, or if the object reaches the border of [-2, 2]^3, twice the
    cube of the cameras.
    """
    if not scene.has_alpha or not scene.cameras.straight:
        return None
    box = CONTRACTIONS.build("box", half_extent=2.0)
    points, radius = bounding_spheres(box, CELLS)
    views = torch.stack([project_spheres(scene, view, points, radius)[-1] for view in scene.train]).sum(0)
    solid = carve(scene, points, radius) & (views >= max(1, len(scene.train) // 2))
    cells = solid.view(CELLS, CELLS, CELLS).nonzero()
    if len(cells) == 0 or bool(((cells == 0) | (cells == CELLS - 1)).any()):
        return None
    corners = torch.stack([cells, cells + 1]).to(torch.float64) / CELLS
    return math.ceil(100 * float((4 * corners - 2).abs().max())) / 100


class Followed:
    """Training rays, evenly spread over all pixels, followed from the camera outwards."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        rays = spread_rays(scene, RAYS)
        self.distances = torch.logspace(-3, 1, 160, dtype=torch.float64)  # world units
        points = rays.origins[:, None] + rays.directions[:, None] * self.distances[:, None]
        self.counts = count_cameras(points.reshape(-1, 3), scene.cameras, scene.train).view(len(points), -1)

    def coverage(self, cameras: int) -> float:
        """Share of the rays that pass, within ten world units, through space seen by at least `cameras` cameras."""
        return float((self.counts >= cameras).any(-1).double().mean())

    def cameras(self) -> int:
        """The largest number of cameras, up to 4, with which 99 % of the rays are covered; 0 if 2 are too many."""
        for cameras in range(MAX_CAMERAS, 1, -1):
            if self.coverage(cameras) >= COVERED:
                return cameras
        return 0

    def near(self, cameras: int) -> float | None:
        """Distance, less a tenth, at which the first ray enters space seen by `cameras` cameras; None: at once."""
        reached = (self.counts >= max(cameras, 1)).any(0)
        first = int(reached.to(torch.int8).argmax())
        return float(self.distances[first]) * (1 - MARGIN) if first else None


def hull_bounds(scene: Scene, half_extent: float) -> tuple[float, float]:
    """Smallest and largest distance (world units) from a training camera to the sphere around the box, with margin."""
    away = torch.linalg.vector_norm(scene.cameras.poses[scene.train][:, :, 3], dim=-1)
    reach = half_extent * math.sqrt(3)
    return max(0.0, (float(away.min()) - reach) * (1 - MARGIN)), (float(away.max()) + reach) * (1 + MARGIN)
