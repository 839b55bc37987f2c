"""Held-out views of a model: rendered, measured, drawn."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from qnerf.geometry.rays import RayTable
from qnerf.model.model import Model
from qnerf.rendering.background import evaluation_background
from qnerf.scenes import Scene
from qnerf.timing import Stopwatch
from qnerf.training.forecast import seconds_each
from qnerf.training.image_metrics import Comparison, measure
from qnerf.types import Rays

MAX_PIXELS = 2**22  # of a depth map, evenly spread, from which its percentiles are computed
ERROR_GAIN = 4.0  # of the panel that shows the error
MAX_PREVIEW = 2**14  # rays; a larger view is rendered in every second, third, ... row and column
MAX_WIDTH = 2**13  # pixels; a picture is not enlarged beyond it


@dataclass(frozen=True)
class RenderedView:
    """One view as the model sees it."""

    view: int
    color: Tensor  # (H, W, 3) in [0, 1]
    depth: Tensor  # (H, W) median distance, world units
    accumulation: Tensor  # (H, W)
    stride: int = 1  # of the rows and columns that were rendered: H and W count these


Tile = tuple[Tensor, Tensor, Tensor]
"""Of R rays: colours (R, 3) in [0, 1], median depth (R,) in world units, accumulation (R,). On the CPU."""


@torch.no_grad()
def tiles_of(
    model: Model,
    rays: Callable[[slice], Rays],
    count: int,
    chunk: int,
    background: str,
    step: int,
    watch: Stopwatch,
) -> Iterator[Tile]:
    """Renders `count` rays, `chunk` at a time, so that memory does not grow with the picture.

    Args:
        model: in evaluation mode.
        rays: returns a part of the rays.
        background: of evaluation, see `evaluation_background`.
        step: of the schedules.
    """
    for start in range(0, count, chunk):
        part = rays(slice(start, min(start + chunk, count)))
        rendering, _, _ = model(part, background=background, step=step, watch=watch)
        yield rendering.color.clamp(0, 1).cpu(), rendering.depth_median.cpu(), rendering.accumulation.cpu()


class Evaluator:
    """Renders and measures views of a scene, deterministically and without touching any random state."""

    def __init__(self, scene: Scene, table: RayTable, model: Model, *, background: str, chunk: int, watch: Stopwatch):
        self.scene = scene
        self.table = table
        self.model = model
        self.background = evaluation_background(background)
        self.chunk = chunk
        self.watch = watch

    @torch.no_grad()
    def render(self, view: int, step: int, stride: int = 1) -> RenderedView:
        """The view, `chunk` rays at a time; every `stride`-th row and column of it."""
        training = self.model.training
        self.model.eval()
        self.watch.begin(measure=False)
        refinement = None if view in self.scene.eval else self.model.cameras
        rays = self.table.view(view, refinement)
        if refinement is None:  # a held-out view has no appearance vector
            rays = replace(rays, cameras=torch.full_like(rays.cameras, -1))
        width, height = self.scene.cameras.size(view)
        if stride > 1:
            numbers = torch.arange(len(rays), device=rays.origins.device).view(height, width)[::stride, ::stride]
            (height, width), rays = numbers.shape, rays[numbers.flatten()]
        tiles = tiles_of(self.model, rays.__getitem__, len(rays), self.chunk, self.background, step, self.watch)
        with torch.random.fork_rng(devices=[]):  # of shots and noise
            torch.default_generator.manual_seed(view)
            color, depth, accumulation = (torch.cat(column) for column in zip(*tiles, strict=True))
        self.model.train(training)
        return RenderedView(
            view, color.view(height, width, 3), depth.view(height, width), accumulation.view(height, width), stride
        )

    @torch.no_grad()
    def seconds(self, count: int) -> float:
        """About how long it takes to render so many rays, under the conditions that the model is in."""
        rays = self.table.view(self.scene.train[0])
        self.model.eval()

        def work(few: int) -> None:
            self.model(rays[:few], background=self.background, step=0, watch=self.watch)

        return count * seconds_each(work, min(self.chunk, len(rays)))

    def truth(self, view: int) -> Tensor:
        """(H, W, 3) in [0, 1], composited on the background where the image has alpha."""
        return self.scene.colors(view, {"black": 0.0}.get(self.background, 1.0))

    def measure(self, rendered: RenderedView) -> dict[str, float | str | None]:
        """The view's name under `image`, and every image metric; see `qnerf.training.image_metrics.measure`."""
        view, step = rendered.view, rendered.stride
        depth = None if self.scene.depth is None else self.scene.depth[view]
        solid = self.scene.image(view)[:, :, 3] >= 128 if self.scene.has_alpha else None
        truth = self.truth(view).double()[::step, ::step]
        specular = None if self.scene.specular is None else self.scene.specular[view]
        depth, mask, solid, specular = (
            None if whole is None else whole[::step, ::step]
            for whole in (depth, self.scene.valid(view), solid, specular)
        )
        compared = Comparison(rendered.color.double(), truth, rendered.depth, depth, mask, solid, step, specular)
        return {"image": self.scene.names[view]} | measure(compared)

    def views(
        self, views: list[int], step: int, rays: int | None = None
    ) -> Iterator[tuple[RenderedView, dict[str, float | str | None]]]:
        """Each view and its measures. rays: about how many of each are rendered, evenly spread; None: all."""
        for view in views:
            rendered = self.render(view, step, 1 if rays is None else self.stride(view, rays))
            yield rendered, self.measure(rendered)

    def picture(self, rendered: RenderedView, min_height: int = 240) -> np.ndarray:
        """truth | render | error (x 4, black where masked) | depth (near is bright) as one image (h, w, 3) uint8.

        A view lower than `min_height` pixels is enlarged by a whole factor, unless the picture would become too wide.
        """
        truth = self.truth(rendered.view)[:: rendered.stride, :: rendered.stride]
        error = shade_error(rendered.color, truth)
        if (valid := self.scene.valid(rendered.view)) is not None:
            error = error * valid[:: rendered.stride, :: rendered.stride, None]
        return beside([truth, rendered.color, error, shade(rendered.depth)], min_height)

    def preview(self, step: int) -> np.ndarray:
        """The picture of the middle one of the held-out views, of at most `MAX_PREVIEW` rays."""
        view = self.scene.eval[len(self.scene.eval) // 2]
        return self.picture(self.render(view, step, self.stride(view, MAX_PREVIEW)))

    def stride(self, view: int, max_rays: int) -> int:
        """Every how many rows and columns of the view make at most `max_rays` rays, about."""
        width, height = self.scene.cameras.size(view)
        return math.ceil(math.sqrt(max(height * width / max_rays, 1)))


def beside(panels: list[Tensor], min_height: int = 240) -> np.ndarray:
    """Panels (H, W, 3) in [0, 1] side by side as one image uint8, enlarged as `Evaluator.picture` says."""
    picture = torch.cat([panel.to(torch.float32) for panel in panels], dim=1)
    height, width, _ = picture.shape
    factor = max(1, min(-(-min_height // height), MAX_WIDTH // width))
    picture = picture.repeat_interleave(factor, 0).repeat_interleave(factor, 1)
    return (picture * 255).round().to(torch.uint8).numpy()


def colormap() -> Any:
    """Of depths. ValueError if matplotlib's own settings (`matplotlibrc`, `MPLBACKEND`) are not usable."""
    import matplotlib

    return matplotlib.colormaps["magma"]


def shade_error(color: Tensor, truth: Tensor) -> Tensor:
    """`ERROR_GAIN` times the mean absolute error of the channels as a grey picture (H, W, 3) in [0, 1]."""
    return ((color - truth).abs().mean(-1, keepdim=True) * ERROR_GAIN).clamp(0, 1).expand(-1, -1, 3)


def depth_range(depth: Tensor) -> tuple[float, float]:
    """The 2nd and the 98th percentile of the inverse depth, 1 / world units."""
    inverse = 1 / depth.clamp(min=1e-3)
    sample = inverse.flatten()[:: -(-inverse.numel() // MAX_PIXELS)]
    low, high = torch.quantile(sample, torch.tensor([0.02, 0.98], dtype=inverse.dtype)).tolist()
    return low, high


def shade(depth: Tensor, between: tuple[float, float] | None = None) -> Tensor:
    """Depth (H, W) -> (H, W, 3) in [0, 1]: inverse depth between two values, near bright; by default `depth_range`."""
    low, high = depth_range(depth) if between is None else between
    scaled = ((1 / depth.clamp(min=1e-3) - low) / max(high - low, 1e-6)).clamp(0, 1)
    return torch.from_numpy(colormap()(scaled.numpy())[..., :3])
