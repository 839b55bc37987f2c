"""Pictures of a trained model from any camera, rendered in tiles."""

import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from qnerf.geometry.camera_paths import Camera, focal_as
from qnerf.probes.trained import Trained
from qnerf.rendering.background import evaluation_background
from qnerf.training.evaluation import Evaluator, RenderedView, depth_range, shade, tiles_of
from qnerf.types import Rays

TILE = 4096  # rays rendered at once, unless the run's train.chunk is smaller
SHADED_WIDTH = 32  # pixels of the pictures from which the range of a video's depth is taken


@dataclass(frozen=True)
class Frame:
    """What a camera sees."""

    color: Tensor  # (H, W, 3) in [0, 1]
    depth: Tensor  # (H, W) median distance, world units
    accumulation: Tensor  # (H, W) opacity


class Renderer:
    """Renders a trained model from any camera."""

    def __init__(self, trained: Trained) -> None:
        self.trained = trained
        settings = trained.settings
        self.table = trained.ray_table()
        self.background = evaluation_background(settings.render.background)
        self.chunk = min(TILE, settings.train.chunk)
        self.watch = trained.stopwatch(trained.model)
        self.watch.begin(measure=False)
        background = settings.render.background
        self.evaluator = Evaluator(
            trained.scene, self.table, trained.model, background=background, chunk=self.chunk, watch=self.watch
        )

    def view(self, view: int, max_rays: int | None = None) -> RenderedView:
        """A view of the scene; with `max_rays` every second, third, ... row and column, so that there are no more."""
        stride = 1 if max_rays is None else self.evaluator.stride(view, max_rays)
        return self.evaluator.render(view, self.trained.step, stride)

    def frame(self, camera: Camera, stopping: Callable[[], bool] = lambda: False) -> Frame | None:
        """What the camera sees.

        stopping: called before each tile; once it is true, there is no picture.
        """
        trained, table = self.trained, self.table

        def rays(part: slice) -> Rays:
            return camera.rays(part, table.near, table.far, device=table.device, dtype=table.dtype)

        count = camera.width * camera.height
        tiles = []
        for tile in tiles_of(trained.model, rays, count, self.chunk, self.background, trained.step, self.watch):
            tiles.append(tile)
            if stopping():
                return None
        color, depth, accumulation = (torch.cat(column) for column in zip(*tiles, strict=True))
        shape = camera.height, camera.width
        return Frame(color.view(*shape, 3), depth.view(shape), accumulation.view(shape))

    def focal(self, width: int, height: int) -> float:
        """The focal length in pixels with which a picture shows as much as the training views do."""
        scene = self.trained.scene
        return statistics.median(focal_as(scene.cameras, view, width, height) for view in scene.train)

    def depth_range(self, cameras: Sequence[Camera]) -> tuple[float, float]:
        """The range of inverse depth that a few of the cameras see, for `shade`."""
        chosen = [cameras[index] for index in np.linspace(0, len(cameras) - 1, min(8, len(cameras))).astype(int)]
        frames = [self.frame(camera.scaled(min(camera.width, SHADED_WIDTH))) for camera in chosen]
        return depth_range(torch.cat([frame.depth.flatten() for frame in frames if frame is not None]))

    def pictures(self, cameras: Sequence[Camera], what: str) -> Iterator[NDArray]:
        """One picture (H, W, 3) uint8 a camera; what: color, or depth (near is bright, one range for all)."""
        between = self.depth_range(cameras) if what == "depth" else None
        for camera in cameras:
            frame = self.frame(camera)
            assert frame is not None
            yield as_bytes(frame.color if between is None else shade(frame.depth, between))


def as_bytes(picture: Tensor) -> NDArray:
    """Colours (..., 3) in [0, 1] -> uint8."""
    return (picture * 255).round().to(torch.uint8).numpy()
