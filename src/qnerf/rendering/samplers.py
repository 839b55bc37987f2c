"""Where a ray is sampled: samplers without networks of their own (`proposal_sampler.py` has the one with networks)."""

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from qnerf.config.bounds import Count, NonNegativeFactor
from qnerf.config.registry import Registry
from qnerf.config.tensors import returned
from qnerf.geometry.contraction import Contraction
from qnerf.geometry.visibility import SpaceMask
from qnerf.rendering.pdf import sample_edges
from qnerf.rendering.render import volume_weights
from qnerf.rendering.spacing import SPACINGS
from qnerf.types import Rays, Samples

Density = Callable[[Tensor], Tensor]
"""World points (R, K, 3) -> density (R, K) per world unit."""

SAMPLERS: "Registry[Sampler]" = Registry("sampler")


@dataclass(frozen=True)
class SampledRays:
    """The samples to render, and the proposal histograms that they were drawn from."""

    samples: Samples
    proposals: list[tuple[Samples, Tensor]]  # weights (R, J) each, with a gradient in steps that train the proposals


class Sampler(nn.Module):
    """Cuts rays into intervals.

    Args:
        contraction: world points (..., 3) -> the unit cube (..., 3), for samplers with networks.
    """

    trainable: ClassVar[bool] = True
    """Whether it has parameters; where not, no learning rate acts on it."""

    rendered_samples: int = 1
    """Samples of a ray that are rendered; 1 where a sampler does not say."""

    def __init__(self, contraction: Contraction) -> None:
        super().__init__()
        self.contraction = contraction
        self.mask: SpaceMask | None = None
        """Where density may be; None: everywhere."""

    def phase(self, step: int) -> Hashable | None:
        """All that `forward` makes of the step; None: it does not read it. See `training/captured.py`."""
        return None

    def __call__(self, rays: Rays, density: Density, **options: Any) -> SampledRays:
        sampled: SampledRays = super().__call__(rays, density, **options)
        for samples, weights in [(sampled.samples, None), *sampled.proposals]:
            edges = returned(self, samples.edges, (len(rays), "K + 1"), rays.origins)
            returned(self, samples.spacing, edges.shape, edges)
            if weights is not None:
                returned(self, weights, (len(rays), edges.shape[1] - 1), edges)
        return sampled

    def forward(
        self, rays: Rays, density: Density, *, generator: torch.Generator | None = None, step: int = 0
    ) -> SampledRays:
        """Samples R rays between their near and far.

        Args:
            density: of the field, for samplers that use it; without gradient.
            generator: of the jitter; None: deterministic.
            step: optimisation step from 0, for schedules.
        """
        raise NotImplementedError


def draw_jitter(rays: Rays, draws: int, generator: torch.Generator | None) -> list[Tensor | None]:
    """`draws` tensors (R, 1) in [0, 1); without a generator, None each: deterministic sampling."""
    if generator is None:
        return [None] * draws
    jitter = torch.rand(draws, len(rays), 1, dtype=rays.origins.dtype, device=generator.device, generator=generator)
    return list(jitter.to(rays.origins.device))


def even_edges(rays: Rays, samples: int, jitter: Tensor | None) -> Tensor:
    """Evenly spaced edges (R, K + 1) in [0, 1]; `jitter` (R, 1) moves each edge between its neighbouring midpoints."""
    edges, low, width = _even(samples, rays.near.dtype, rays.near.device)
    return edges.expand(len(rays), -1) if jitter is None else torch.addcmul(low, width, jitter)


@cache
def _even(samples: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Even edges (K + 1,) in [0, 1]; where each may begin to be moved, and how far."""
    edges = torch.linspace(0, 1, samples + 1, dtype=dtype, device=device)
    mids = (edges[1:] + edges[:-1]) / 2
    low = torch.cat([edges[:1], mids])
    return edges, low, torch.cat([mids, edges[-1:]]) - low


class SpacedSampler(Sampler):
    """`samples` intervals, equally long in the normalised coordinate of `spacing`, with one jitter per ray."""

    trainable = False

    spacing: str

    def __init__(self, contraction: Contraction, *, samples: Count = 128) -> None:
        super().__init__(contraction)
        self.rendered_samples = self.samples = samples

    @torch.no_grad()
    def forward(
        self, rays: Rays, density: Density, *, generator: torch.Generator | None = None, step: int = 0
    ) -> SampledRays:
        rays = rays.detach()
        s = even_edges(rays, self.samples, draw_jitter(rays, 1, generator)[0])
        spacing = SPACINGS.build(self.spacing, rays.near, rays.far)
        return SampledRays(Samples(spacing.to_world(s), s), [])


for _name in SPACINGS.names():  # each spacing is a sampler of the same name
    SAMPLERS.register(_name)(type(f"{_name.capitalize()}Sampler", (SpacedSampler,), {"spacing": _name}))


@SAMPLERS.register("vanilla")
class VanillaSampler(Sampler):
    """Hierarchical sampling with the field itself (Sec. 5.2, arXiv:2003.08934) instead of a second, coarse network.

    Args:
        coarse: even intervals, weighted by the field's density.
        fine: edges drawn from the coarse weights; they join the coarse edges.
        spacing: piecewise | uniform | disparity | geometric.
        padding: added to every weight before drawing.
    """

    trainable = False

    def __init__(
        self,
        contraction: Contraction,
        *,
        coarse: Count = 64,
        fine: Count = 128,
        spacing: str = "uniform",
        padding: NonNegativeFactor = 0.01,
    ) -> None:
        super().__init__(contraction)
        SPACINGS.get(spacing)
        self.coarse, self.fine, self.spacing, self.padding = coarse, fine, spacing, padding
        self.rendered_samples = coarse + fine

    @torch.no_grad()
    def forward(
        self, rays: Rays, density: Density, *, generator: torch.Generator | None = None, step: int = 0
    ) -> SampledRays:
        rays = rays.detach()
        coarse_jitter, fine_jitter = draw_jitter(rays, 2, generator)
        spacing = SPACINGS.build(self.spacing, rays.near, rays.far)
        s = even_edges(rays, self.coarse, coarse_jitter)
        coarse = Samples(spacing.to_world(s), s)
        weights = volume_weights(density(rays.along(coarse.mids)), coarse.deltas)
        drawn = sample_edges(s, weights, self.fine, padding=self.padding, jitter=fine_jitter)
        s = torch.cat([s, drawn], dim=-1).sort(-1).values
        return SampledRays(Samples(spacing.to_world(s), s), [])
