"""Where rays are sampled: by the run's own sampler, level by level, and by fixed spacings for comparison."""

from collections.abc import Iterator
from dataclasses import replace

import pandas as pd
import torch
from torch import Tensor

from qnerf.probes.trained import Trained
from qnerf.rendering.render import volume_weights
from qnerf.rendering.samplers import SAMPLERS
from qnerf.types import Rays, Samples

PIXELS = ((0.5, 0.5), (0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75))
"""As shares of the image's width and height; the centre first."""

FIXED_SPACINGS = ("uniform", "disparity", "piecewise")


def table(trained: Trained) -> pd.DataFrame:
    """One row for each interval of each strategy on a few rays of the first held-out view.

    Columns: image; pixel_x, pixel_y; strategy: the run's sampler, or a fixed spacing with as many intervals as the run
    renders; own: true for the run's sampler; level: network 0, 1, ..., final; interval; start, end: distances along the
    ray, world units; weight: share of the ray's colour, from the density of the level (a proposal network's, or the
    field's at the final level); transmittance in front of the interval; depth: true distance in world units, NaN where
    unknown.
    """
    view = trained.scene.eval[0]
    all_rays = trained.ray_table()
    width, height = all_rays.cameras.size(view)
    columns = torch.tensor([int(x * (width - 1)) for x, _ in PIXELS], device=all_rays.device)
    rows = torch.tensor([int(y * (height - 1)) for _, y in PIXELS], device=all_rays.device)
    rays = all_rays.rays(torch.full_like(rows, view), rows * width + columns)
    rays = replace(rays, cameras=torch.full_like(rays.cameras, -1))
    parts = [_rows(*level) for level in _levels(trained, rays)]
    depth = None if trained.scene.depth is None else trained.scene.depth[view][rows.cpu(), columns.cpu()].numpy()
    pixels = pd.DataFrame({"ray": range(len(rows)), "pixel_x": columns.cpu(), "pixel_y": rows.cpu(), "depth": depth})
    joined = pd.concat(parts, ignore_index=True).merge(pixels.astype({"depth": "float64"}), on="ray")
    return joined.drop(columns="ray").assign(image=trained.scene.names[view])


@torch.no_grad()
def _levels(trained: Trained, rays: Rays) -> Iterator[tuple[str, bool, str, Samples, Tensor]]:
    """Strategy, whether it is the run's own, level, intervals, weights (R, K)."""
    field, sampler = trained.model.field, trained.model.sampler
    name = trained.settings.sampler["name"]
    sampled = sampler(rays, field.density, step=trained.step)
    for number, (samples, weights) in enumerate(sampled.proposals):
        yield name, True, f"network {number}", samples, weights
    count = sampled.samples.mids.shape[1]
    yield name, True, "final", sampled.samples, _weights(trained, rays, sampled.samples)
    for other in FIXED_SPACINGS:
        if other != name:
            samples = SAMPLERS.build(other, field.contraction, samples=count)(rays, field.density).samples
            yield other, False, "final", samples, _weights(trained, rays, samples)


def _weights(trained: Trained, rays: Rays, samples: Samples) -> Tensor:
    return volume_weights(trained.model.field.density(rays.along(samples.mids)), samples.deltas)


def _rows(strategy: str, own: bool, level: str, samples: Samples, weights: Tensor) -> pd.DataFrame:
    weights = weights.double()
    before = 1 - torch.nn.functional.pad(weights.cumsum(-1)[:, :-1], (1, 0))
    count, intervals = weights.shape
    edges = samples.edges.double().cpu().numpy()
    return pd.DataFrame(
        {
            "strategy": strategy,
            "own": own,
            "level": level,
            "ray": torch.arange(count).repeat_interleave(intervals).numpy(),
            "interval": torch.arange(intervals).repeat(count).numpy(),
            "start": edges[:, :-1].ravel(),
            "end": edges[:, 1:].ravel(),
            "weight": weights.cpu().numpy().ravel(),
            "transmittance": before.clamp(min=0).cpu().numpy().ravel(),
        }
    )
