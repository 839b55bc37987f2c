"""Where a scene lies: whether it is bounded, and which part of a ray the training cameras can say anything about."""

import math

import numpy as np
import torch

from qnerf.geometry.contraction import CONTRACTIONS
from qnerf.geometry.hull import bounding_spheres, carve, project_spheres
from qnerf.geometry.rays import camera_rays
from qnerf.geometry.visibility import count_cameras
from qnerf.scenes import Scene

CELLS = 48  # an axis of the grids here
MOST_CAMERAS = 4
COVERED = 0.99  # share of training rays that must meet space seen by enough cameras
RAYS = 2000  # training rays that are followed
MARGIN = 0.1  # kept in front of the nearest thing and behind the farthest


def box_half_extent(scene: Scene) -> float | None:
    """Half the side of the cube around the origin that holds what silhouettes leave of the space that half of the
    training cameras wholly see, in world units.

    None without alpha, with a lens distortion, and where nothing is left or what is left reaches the border of a cube
    twice that of the cameras.
    """
    if scene.images.shape[-1] != 4 or bool(scene.cameras.distortion.any()):
        return None
    box = CONTRACTIONS.build("box", half_extent=2.0)
    points, radius = bounding_spheres(box, CELLS)
    views = torch.stack([project_spheres(scene, view, points, radius)[-1] for view in scene.train]).sum(0)
    held = carve(scene, points, radius) & (views >= max(1, len(scene.train) // 2))
    cells = held.view(CELLS, CELLS, CELLS).nonzero()
    if len(cells) == 0 or bool(((cells == 0) | (cells == CELLS - 1)).any()):
        return None
    corners = torch.stack([cells, cells + 1]).to(torch.float64) / CELLS
    return math.ceil(100 * float((4 * corners - 2).abs().max())) / 100


class Followed:
    """Training rays, evenly spread over all pixels, followed from the camera outwards."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        cameras = scene.cameras
        total = len(scene.train) * cameras.width * cameras.height
        chosen = torch.from_numpy(np.linspace(0, total - 1, min(RAYS, total)).astype(np.int64))
        pixels = cameras.width * cameras.height
        views = torch.tensor(scene.train)[chosen // pixels]
        place = chosen % pixels
        centres = torch.stack([place % cameras.width, place // cameras.width], dim=-1) + 0.5
        rays = camera_rays(cameras, views, centres, 0.0, 1.0, torch.float64)
        self.distances = torch.logspace(-3, 1, 160, dtype=torch.float64)  # world units
        points = rays.origins[:, None] + rays.directions[:, None] * self.distances[:, None]
        self.counts = count_cameras(points.reshape(-1, 3), cameras, scene.train).view(len(views), -1)

    def coverage(self, cameras: int) -> float:
        """Share of the rays that somewhere pass space seen by at least so many cameras, within ten world units."""
        return float((self.counts >= cameras).any(-1).double().mean())

    def cameras(self) -> int:
        """The most cameras, up to 4, that can be asked for with 99 % of the rays covered; 0: not even 2."""
        for cameras in range(MOST_CAMERAS, 1, -1):
            if self.coverage(cameras) >= COVERED:
                return cameras
        return 0

    def near(self, cameras: int) -> float | None:
        """The distance before which no ray passes space seen by so many cameras, less a tenth; None: from the start."""
        reached = (self.counts >= max(cameras, 1)).any(0)
        first = int(reached.to(torch.int8).argmax())
        return float(self.distances[first]) * (1 - MARGIN) if first else None


def hull_bounds(scene: Scene, half_extent: float) -> tuple[float, float]:
    """Least and largest distance, world units, from a training camera to the sphere around the box, with a margin."""
    away = torch.linalg.vector_norm(scene.cameras.poses[scene.train][:, :, 3], dim=-1)
    reach = half_extent * math.sqrt(3)
    return max(0.0, (float(away.min()) - reach) * (1 - MARGIN)), (float(away.max()) + reach) * (1 + MARGIN)
