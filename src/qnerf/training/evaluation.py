"""A model's held-out views: rendered, measured, drawn."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from qnerf.geometry.rays import RayTable
from qnerf.model.model import Model
from qnerf.rendering.background import evaluation_background
from qnerf.scenes import Scene
from qnerf.timing import Stopwatch
from qnerf.training.image_metrics import depth_error, lpips, psnr, ssim

MOST = 2**22  # pixels of which percentiles are taken, evenly spread


@dataclass(frozen=True)
class RenderedView:
    """One view as the model sees it."""

    view: int
    color: Tensor  # (H, W, 3) in [0, 1]
    depth: Tensor  # (H, W) median distance, world units
    accumulation: Tensor  # (H, W)


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
    def render(self, view: int, step: int) -> RenderedView:
        """The view at full resolution, `chunk` rays at a time."""
        training = self.model.training
        self.model.eval()
        self.watch.begin(measure=False)
        refinement = None if view in self.scene.eval else self.model.cameras
        rays = self.table.view(view, refinement)
        if refinement is None:  # no appearance of its own
            rays = replace(rays, cameras=torch.full_like(rays.cameras, -1))
        pieces = []
        for start in range(0, len(rays), self.chunk):
            part = rays[start : start + self.chunk]
            rendering, _, _ = self.model(part, background=self.background, step=step, watch=self.watch)
            pieces.append((rendering.color.clamp(0, 1), rendering.depth_median, rendering.accumulation))
        self.model.train(training)
        color, depth, accumulation = (torch.cat(column).cpu() for column in zip(*pieces, strict=True))
        height, width = self.scene.cameras.height, self.scene.cameras.width
        return RenderedView(
            view, color.view(height, width, 3), depth.view(height, width), accumulation.view(height, width)
        )

    def truth(self, view: int) -> Tensor:
        """(H, W, 3) in [0, 1], composited on the background where the image has alpha."""
        return self.scene.colors(view, {"black": 0.0}.get(self.background, 1.0))

    def measure(self, rendered: RenderedView) -> dict[str, float | str | None]:
        """PSNR in dB, SSIM, LPIPS (None with a reason where it cannot be had), depth errors where depth is known."""
        view = rendered.view
        truth = self.truth(view).double()
        color = rendered.color.double()
        perceptual, reason = lpips(color, truth)
        row: dict[str, float | str | None] = {
            "image": self.scene.names[view],
            "psnr": psnr(color, truth),
            "ssim": ssim(color, truth),
            "lpips": perceptual,
            "lpips_reason": reason,
            "depth_error": None,
            "depth_error_median": None,
        }
        if self.scene.depth is not None:
            relative, median = depth_error(rendered.depth, self.scene.depth[view])
            row |= {"depth_error": relative, "depth_error_median": median}
        return row

    def views(self, views: list[int], step: int) -> Iterator[tuple[RenderedView, dict[str, float | str | None]]]:
        for view in views:
            rendered = self.render(view, step)
            yield rendered, self.measure(rendered)

    def picture(self, rendered: RenderedView, least: int = 240) -> np.ndarray:
        """truth | render | error (x 4) | depth (near is bright) as one image (h, w, 3) uint8, small views enlarged."""
        truth = self.truth(rendered.view)
        error = ((rendered.color - truth).abs().mean(-1, keepdim=True) * 4).clamp(0, 1).expand(-1, -1, 3)
        panels = [truth, rendered.color, error, shade(rendered.depth)]
        row = torch.cat([panel.to(torch.float32) for panel in panels], dim=1)
        factor = max(1, -(-least // row.shape[0]))
        row = row.repeat_interleave(factor, 0).repeat_interleave(factor, 1)
        return (row * 255).round().to(torch.uint8).numpy()


def shade(depth: Tensor) -> Tensor:
    """Depth (H, W) -> (H, W, 3) in [0, 1]: inverse depth between its 2nd and 98th percentile, near bright."""
    import matplotlib

    inverse = 1 / depth.clamp(min=1e-3)
    some = inverse.flatten()[:: -(-inverse.numel() // MOST)]
    low, high = torch.quantile(some, torch.tensor([0.02, 0.98], dtype=inverse.dtype))
    scaled = ((inverse - low) / (high - low).clamp(min=1e-6)).clamp(0, 1)
    return torch.from_numpy(matplotlib.colormaps["magma"](scaled.numpy())[..., :3])
