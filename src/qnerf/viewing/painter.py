"""What the viewer shows: colour, depth or error, of one run or of two runs of one scene."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from qnerf.geometry.camera_paths import Camera
from qnerf.geometry.rays import project
from qnerf.records import state
from qnerf.training.evaluation import RenderedView, shade, shade_error
from qnerf.viewing.frames import Frame, Renderer, as_bytes

VIEW_RAYS = 2**14  # of the view whose error is shown, at most
WHAT = ("color", "depth", "error")


@dataclass(frozen=True)
class Shown:
    """What a picture shows: `what` is one of `WHAT`, `run` the number of the run, or None for two halves."""

    what: str = "color"
    run: int | None = 0


class Painter:
    """Draws pictures of one run, or of two runs of one scene, one at a time.

    Raises:
        ValueError: the runs have different worlds.
    """

    def __init__(self, renderers: Sequence[Renderer]) -> None:
        self.renderers = list(renderers)
        self.lock = threading.Lock()
        self._written: list[tuple[int, int] | None] = [None for _ in renderers]  # of the checkpoint that each has
        self._errors: dict[tuple[int, int, int], tuple[torch.Tensor, RenderedView]] = {}  # of run, step, view
        first, *others = (renderer.trained for renderer in renderers)
        for other in others:
            if not np.allclose(first.scene.transform, other.scene.transform):
                raise ValueError(f"{first.folder.name} and {other.folder.name} are runs of different scenes")

    def picture(self, camera: Camera, shown: Shown, stopping: Callable[[], bool] = lambda: False) -> NDArray | None:
        """(H, W, 3) uint8; None once `stopping()`. Of two halves, the left one is the first run."""
        with self.lock:
            parts = []
            for run in range(len(self.renderers)) if shown.run is None else [shown.run]:
                frame = self.renderers[run].frame(camera, stopping)
                if frame is None:
                    return None
                parts.append(as_bytes(self._drawn(run, frame, camera, shown.what)))
        if len(parts) == 1:
            return parts[0]
        half = camera.width // 2
        divider = np.full((camera.height, 1, 3), 255, np.uint8)
        return np.concatenate([parts[0][:, :half], divider, parts[1][:, half + 1 :]], axis=1)

    def _drawn(self, run: int, frame: Frame, camera: Camera, what: str) -> torch.Tensor:
        if what == "color":
            return frame.color
        return shade(frame.depth) if what == "depth" else self._error(run, frame, camera)

    def _error(self, run: int, frame: Frame, camera: Camera) -> torch.Tensor:
        """The error of the nearest photograph on the surfaces that it shows; elsewhere, darkly, the rendering."""
        renderer = self.renderers[run]
        cameras, view = renderer.trained.scene.cameras, self.nearest(camera)
        key = run, renderer.trained.step, view
        if key not in self._errors:
            self._errors.clear()
            rendered = renderer.view(view, VIEW_RAYS)
            truth = renderer.evaluator.truth(view)[:: rendered.stride, :: rendered.stride]
            self._errors[key] = shade_error(rendered.color, truth), rendered
        error, rendered = self._errors[key]
        rays = camera.rays(slice(None), 0.0, 1.0, dtype=torch.float64)
        points = rays.origins + rays.directions * frame.depth.flatten()[:, None]
        pixels, ahead = project(cameras, torch.full((len(points),), view), points)
        row, column, inside = rendered.locate(pixels)
        apart = torch.linalg.vector_norm(points - cameras.poses[view][:, 3], dim=1)
        inside &= (ahead > 0) & (apart < 1.1 * rendered.depth[row, column])  # not behind what the photograph shows
        return torch.where(inside.view(*frame.depth.shape, 1), error[row, column].view_as(frame.color), frame.color / 4)

    def nearest(self, camera: Camera) -> int:
        """The view that stands and looks most as the camera does."""
        poses = self.renderers[0].trained.scene.cameras.poses.numpy()
        apart = np.linalg.norm(poses[:, :, 3] - camera.pose[:, 3], axis=1)
        return int((apart + 1 - poses[:, :, 2] @ camera.pose[:, 2]).argmin())

    def reload(self) -> bool:
        """Takes the checkpoints that were written since the last call; returns whether there were any."""
        news = False
        for number, renderer in enumerate(self.renderers):
            written = _written(renderer)
            if written != self._written[number]:
                with self.lock:
                    renderer.trained = renderer.trained.reloaded()
                self._written[number] = written
                news = True
        return news

    def texts(self) -> list[str]:
        """A line on each run: id, state, step."""
        lines = []
        for renderer in self.renderers:
            trained = renderer.trained
            now = f"{state(trained.folder)}, checkpoint of step {trained.step:,} of {trained.settings.train.steps:,}"
            lines.append(f"{trained.folder.name}: {now}")
        return lines


def _written(renderer: Renderer) -> tuple[int, int] | None:
    """What tells one checkpoint of the run from the next."""
    try:
        found = (renderer.trained.folder / "checkpoint.pt").stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_ino
