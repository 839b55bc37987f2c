"""`SparseDepths`: training pixels whose depth is known, from the sparse points of a reconstruction."""

import torch
from torch import Tensor

from qnerf.geometry.rays import TrainingPixels, project
from qnerf.scenes.base import Scene


class SparseDepths:
    """The training pixels on which a sparse point falls, and its distance from their camera.

    Args:
        scene: with `points`, of which those count that lie in front of a training view and on a pixel of it.
        validation_stride: as in `RayTable`; the pixels that it holds out are left out.

    Raises:
        ValueError: the scene has no sparse points, or none is seen by a training view.
    """

    def __init__(self, scene: Scene, validation_stride: int = 0) -> None:
        if scene.points is None:
            advice = "scene=colmap reads them with scene.points=true"
            raise ValueError(f"train.losses.sparse_depth: the scene {scene.name} has no sparse points; {advice}")
        views, points = scene.points[:, 0].long(), scene.points[:, 1:]
        pixels, depth = project(scene.cameras, views, points)
        sizes = scene.cameras.all_sizes[views]
        inside = (depth > 0) & ((pixels >= 0) & (pixels < sizes)).all(1)
        views, points, column_row = views[inside], points[inside], pixels[inside].long()
        numbers = TrainingPixels(scene).number(views, column_row[:, 1] * sizes[inside, 0] + column_row[:, 0])
        trains = numbers >= 0
        if validation_stride:
            trains &= (numbers + 1) % validation_stride != 0
        self.numbers = numbers[trains]  # of the training pixels
        self.distances = (points - scene.cameras.poses[views, :, 3]).norm(dim=1)[trains]  # world units
        if not len(self.numbers):
            told = f"none of the scene's {len(scene.points)} sparse points is on a training pixel"
            raise ValueError(f"train.losses.sparse_depth: {told}")

    def draw(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Numbers of `count` such pixels, drawn with replacement, and their distances in world units; both (count,)."""
        drawn = torch.randint(len(self.numbers), (count,), generator=generator)
        return self.numbers[drawn], self.distances[drawn]
