"""Where a ray is sampled: the samplers, and the proposal networks that guide one of them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from qnerf.config.checks import at_least
from qnerf.config.registry import Registry
from qnerf.encoders.hash import HashEncoder
from qnerf.geometry.visibility import SpaceMask
from qnerf.kernels import compiled, proposal
from qnerf.model.activations import trunc_exp
from qnerf.rendering.pdf import sample_edges
from qnerf.rendering.render import volume_weights
from qnerf.rendering.spacing import SPACINGS
from qnerf.types import Rays, Samples

Density = Callable[[Tensor], Tensor]
"""World points (R, K, 3) -> density (R, K) per world unit."""

SAMPLERS: "Registry[Sampler]" = Registry("sampler")

_ALWAYS = 10  # the proposal networks learn in each of the first steps


@dataclass(frozen=True)
class SampledRays:
    """The samples to render, and the histograms that led to them: their weights have a gradient if they learn."""

    samples: Samples
    proposals: list[tuple[Samples, Tensor]]  # weights (R, J) each


class Sampler(nn.Module):
    """Chooses intervals on rays.

    Args:
        contraction: world points (..., 3) -> the unit cube; for samplers with networks of their own.
    """

    def __init__(self, contraction: nn.Module) -> None:
        super().__init__()
        self.contraction = contraction
        self.mask: SpaceMask | None = None
        """Where density may be; None for everywhere."""

    def forward(
        self, rays: Rays, density: Density, *, generator: torch.Generator | None = None, step: int = 0
    ) -> SampledRays:
        """Samples R rays.

        Args:
            rays: near and far bound the samples.
            density: the field's own, for samplers that look at it; no gradient passes.
            generator: of the jitter; None is deterministic (bin midpoints).
            step: optimisation step from 0, which the schedules depend on.
        """
        raise NotImplementedError


def _jitter(rays: Rays, draws: int, generator: torch.Generator | None) -> list[Tensor | None]:
    """`draws` tensors (R, 1) in [0, 1), or None each for deterministic sampling."""
    if generator is None:
        return [None] * draws
    drawn = torch.rand(draws, len(rays), 1, dtype=rays.origins.dtype, device=generator.device, generator=generator).to(
        rays.origins.device
    )
    return list(drawn)


def even_edges(rays: Rays, samples: int, jitter: Tensor | None) -> Tensor:
    """Edges (R, K + 1) evenly spaced in [0, 1]; `jitter` (R, 1) moves each between the midpoints beside it."""
    near = rays.near
    edges = torch.linspace(0, 1, samples + 1, dtype=near.dtype, device=near.device)
    if jitter is None:
        return edges.expand(len(rays), -1)
    mids = (edges[1:] + edges[:-1]) / 2
    low = torch.cat([edges[:1], mids])
    high = torch.cat([mids, edges[-1:]])
    return torch.addcmul(low, high - low, jitter)


class SpacedSampler(Sampler):
    """`samples` intervals of equal length in a spacing's coordinate, one jitter a ray."""

    spacing: str

    def __init__(self, contraction: nn.Module, *, samples: int = 128) -> None:
        super().__init__(contraction)
        at_least("samples", samples, 1)
        self.samples = samples

    @torch.no_grad()
    def forward(
        self, rays: Rays, density: Density, *, generator: torch.Generator | None = None, step: int = 0
    ) -> SampledRays:
        s = even_edges(rays, self.samples, _jitter(rays, 1, generator)[0])
        spacing = SPACINGS.build(self.spacing, rays.near, rays.far)
        return SampledRays(Samples(spacing.to_world(s), s), [])


@SAMPLERS.register("uniform")
class UniformSampler(SpacedSampler):
    spacing = "uniform"


@SAMPLERS.register("disparity")
class DisparitySampler(SpacedSampler):
    spacing = "disparity"


@SAMPLERS.register("geometric")
class GeometricSampler(SpacedSampler):
    spacing = "geometric"


@SAMPLERS.register("piecewise")
class PiecewiseSampler(SpacedSampler):
    spacing = "piecewise"


@SAMPLERS.register("vanilla")
class VanillaSampler(Sampler):
    """Coarse to fine with the field itself (Sec. 5.2, arXiv:2003.08934), without a second network.

    `coarse` even intervals are weighted by the field's density; `fine` edges drawn from them join the coarse ones.
    """

    def __init__(
        self,
        contraction: nn.Module,
        *,
        coarse: int = 64,
        fine: int = 128,
        spacing: str = "uniform",
        padding: float = 0.01,
    ) -> None:
        super().__init__(contraction)
        at_least("coarse", coarse, 1)
        at_least("fine", fine, 1)
        at_least("padding", padding, 0)
        SPACINGS.get(spacing)
        self.coarse, self.fine, self.spacing, self.padding = coarse, fine, spacing, padding

    @torch.no_grad()
    def forward(
        self, rays: Rays, density: Density, *, generator: torch.Generator | None = None, step: int = 0
    ) -> SampledRays:
        jitters = _jitter(rays, 2, generator)
        spacing = SPACINGS.build(self.spacing, rays.near, rays.far)
        s = even_edges(rays, self.coarse, jitters[0])
        coarse = Samples(spacing.to_world(s), s)
        weights = volume_weights(density(rays.along(coarse.mids)), coarse.deltas)
        drawn = sample_edges(s, weights, self.fine, padding=self.padding, jitter=jitters[1])
        s = torch.cat([s, drawn], dim=-1).sort(-1).values
        return SampledRays(Samples(spacing.to_world(s), s), [])


class ProposalNetwork(nn.Module):
    """Unit-cube points (N, 3) -> density (N,): a small hash grid, Linear, ReLU, Linear, trunc_exp."""

    def __init__(
        self, *, levels: int, min_resolution: int, max_resolution: int, log2_table_size: int, features: int, hidden: int
    ) -> None:
        super().__init__()
        self.encoder = HashEncoder(
            3,
            levels=levels,
            min_resolution=min_resolution,
            max_resolution=max_resolution,
            log2_table_size=log2_table_size,
            features=features,
        )
        self.hidden = nn.Linear(self.encoder.out_dim, hidden)
        self.out = nn.Linear(hidden, 1)

    def forward(self, points: Tensor) -> Tensor:
        return trunc_exp(self.out(self.hidden(self.encoder(points)).relu_())[:, 0])

    def tensors(self) -> tuple[Any, ...]:
        """What `kernels.proposal.propose` needs of it."""
        grid, hidden, out = self.encoder, self.hidden, self.out
        layers = (hidden.weight, hidden.bias), (out.weight, out.bias)
        return grid.table, grid.resolutions, grid.dense, *layers


@SAMPLERS.register("proposal")
class ProposalSampler(Sampler):
    """Proposal networks, each drawing the next one's intervals, then the final ones (Sec. 3, arXiv:2111.12077).

    The first intervals are even in `spacing`; each further set is drawn from the weights^a of the one before, where
    a = slope x / ((slope - 1) x + 1), x = min(step / anneal_steps, 1), so that sampling starts out even. The networks
    take part in gradients in the first 10 steps and then once every `update_every` steps (see `learns`).

    Args:
        contraction: world points (..., 3) -> the unit cube.
        samples: intervals a ray, one number a network.
        final: intervals a ray to render.
        spacing: piecewise | uniform | disparity | geometric.
        update_every: steps between gradients of the networks.
        update_warmup: steps over which that interval grows linearly from 1 to `update_every`.
        anneal_steps: steps until the weights are taken as they are; 0: from the start.
        anneal_slope: of the annealing at its start.
        padding: added to every weight before drawing.
        levels, base_resolution, max_resolutions, log2_table_size, features, hidden: of the networks' hash grids (one
            finest resolution a network) and of their one hidden layer.
    """

    def __init__(
        self,
        contraction: nn.Module,
        *,
        samples: list[int] = [256, 96],  # noqa: B006 (read only)
        final: int = 48,
        spacing: str = "piecewise",
        update_every: int = 5,
        update_warmup: int = 0,
        anneal_steps: int = 1000,
        anneal_slope: float = 10.0,
        padding: float = 0.01,
        levels: int = 5,
        base_resolution: int = 16,
        max_resolutions: list[int] = [128, 256],  # noqa: B006
        log2_table_size: int = 17,
        features: int = 2,
        hidden: int = 16,
    ) -> None:
        super().__init__(contraction)
        if not samples or len(samples) != len(max_resolutions):
            raise ValueError(
                f"sampler=proposal: samples and max_resolutions need one number a network, got {list(samples)} and "
                f"{list(max_resolutions)}"
            )
        for count in samples:
            at_least("samples", count, 1)
        at_least("final", final, 1)
        at_least("update_every", update_every, 1)
        at_least("update_warmup", update_warmup, 0)
        at_least("anneal_steps", anneal_steps, 0)
        at_least("anneal_slope", anneal_slope, 1)
        at_least("padding", padding, 0)
        at_least("hidden", hidden, 1)
        SPACINGS.get(spacing)
        self.samples, self.final, self.spacing, self.padding = tuple(samples), final, spacing, padding
        self.update_every, self.anneal_steps, self.anneal_slope = update_every, anneal_steps, anneal_slope
        self._early, self._last = _early_updates(update_every, update_warmup)
        self.networks = nn.ModuleList(
            ProposalNetwork(
                levels=levels,
                min_resolution=base_resolution,
                max_resolution=resolution,
                log2_table_size=log2_table_size,
                features=features,
                hidden=hidden,
            )
            for resolution in max_resolutions
        )

    def learns(self, step: int) -> bool:
        """Whether the networks take part in the gradient of this step; depends on nothing but the step."""
        if step <= self._last:
            return step in self._early
        return (step - self._last) % self.update_every == 0

    def anneal(self, step: int) -> float:
        """Exponent of the weights at this step, from 0 (even) to 1."""
        if step >= self.anneal_steps:
            return 1.0
        x = step / self.anneal_steps
        return self.anneal_slope * x / ((self.anneal_slope - 1) * x + 1)

    def proposed(self, network: nn.Module, points: Tensor) -> Tensor:
        """Density (R, K) that a network proposes at world points (R, K, 3)."""
        unit = self.contraction(points).reshape(-1, 3)
        if compiled(unit) and not torch.is_grad_enabled():
            assert isinstance(network, ProposalNetwork)
            raw = proposal.propose(unit, None if self.mask is None else self.mask.grid, *network.tensors())
            return raw.exp_().view(points.shape[:-1])
        density = network(unit)
        if self.mask is not None:
            density = density.masked_fill(~self.mask(unit), 0)  # infinity times 0 would be NaN
        return density.view(points.shape[:-1])

    def forward(
        self, rays: Rays, density: Density, *, generator: torch.Generator | None = None, step: int = 0
    ) -> SampledRays:
        learns = torch.is_grad_enabled() and self.learns(step)
        exponent = self.anneal(step)
        first, *others = _jitter(rays, len(self.samples) + 1, generator)
        proposals = []
        with torch.no_grad():
            spacing = SPACINGS.build(self.spacing, rays.near, rays.far)
            s = even_edges(rays, self.samples[0], first)
        for network, jitter, count in zip(self.networks, others, (*self.samples[1:], self.final), strict=True):
            with torch.no_grad():
                intervals = Samples(spacing.to_world(s), s)
                points = rays.along(intervals.mids)
            with torch.set_grad_enabled(learns):
                weights = volume_weights(self.proposed(network, points), intervals.deltas)
            proposals.append((intervals, weights))
            with torch.no_grad():
                drawn = weights if exponent == 1 else weights.pow(exponent)
                s = sample_edges(s, drawn, count + 1, padding=self.padding, jitter=jitter)
        with torch.no_grad():
            return SampledRays(Samples(spacing.to_world(s), s), proposals)


def _early_updates(every: int, warmup: int) -> tuple[frozenset[int], int]:
    """The learning steps until the interval between them is constant, and the last of these steps."""
    steps, last = set(range(_ALWAYS)), _ALWAYS - 1
    while last < warmup:
        step = last + 1
        while step - last < min(max(every * min(step / warmup, 1.0), 1.0), every):
            step += 1
        steps.add(step)
        last = step
    return frozenset(steps), last
