"""Proposal sampling: small networks that learn where the field has density (Sec. 3, arXiv:2111.12077)."""

from typing import Annotated, Any

import torch
from annotated_types import Interval, Len
from torch import Tensor, nn

from qnerf.config.bounds import Count, NonNegativeFactor, NonNegativeInt, PositiveInt
from qnerf.encoders.hash import EntryFeatures, HashEncoder, Levels, Log2Size, Resolution
from qnerf.geometry.contraction import Contraction
from qnerf.geometry.unit_points import numbers_of, unit_points
from qnerf.heads.activations import trunc_exp
from qnerf.kernels.dispatch import serves
from qnerf.kernels.grid_mlp import Grid, grid_mlp
from qnerf.kernels.mlp import Layer
from qnerf.kernels.proposals import KNOWN_SPACINGS, Draws, Space, in_world, propose
from qnerf.rendering.pdf import MIN_TOTAL, sample_edges
from qnerf.rendering.render import volume_weights
from qnerf.rendering.samplers import SAMPLERS, Density, SampledRays, Sampler, draw_jitter, even_edges
from qnerf.rendering.spacing import SPACINGS
from qnerf.types import Rays, Samples

_FIRST_STEPS = 10  # the proposal networks are trained in every one of these


class ProposalNetwork(nn.Module):
    """Unit-cube points (N, 3) -> density (N,): hash grid (options `grid`), Linear, ReLU, Linear, trunc_exp."""

    def __init__(self, hidden: int, **grid: Any) -> None:
        super().__init__()
        self.encoder = HashEncoder(3, **grid)
        self.hidden = nn.Linear(self.encoder.out_dim, hidden)
        self.out = nn.Linear(hidden, 1)

    def forward(self, points: Tensor) -> Tensor:
        return trunc_exp(self.out(self.hidden(self.encoder(points)).relu_())[:, 0])

    @property
    def parts(self) -> tuple[Grid, list[Layer]]:
        """What a compiled loop takes of it."""
        return self.encoder.as_grid(), [Layer(layer.weight, layer.bias) for layer in (self.hidden, self.out)]

    def inside(self, points: Tensor, inside: Tensor | None) -> Tensor:
        """The same in a compiled loop; the density is 0 at points that are not `inside` (N,)."""
        return trunc_exp(grid_mlp(points, inside, *self.parts)[:, 0])


@SAMPLERS.register("proposal")
class ProposalSampler(Sampler):
    """Each proposal network draws the intervals of the next one; the last draws the intervals to render.

    The first intervals are even in `spacing`. Each further set is drawn from the previous weights to the power
    a = slope x / ((slope - 1) x + 1), x = min(step / anneal_steps, 1), so that sampling starts out even. The networks
    get gradients in the first 10 steps and then once every `update_every` steps (see `learns`).

    Args:
        contraction: world points (..., 3) -> the unit cube (..., 3).
        samples: intervals per ray, one number for each network.
        final: intervals per ray to render.
        spacing: piecewise | uniform | disparity | geometric.
        update_every: steps between gradients of the networks.
        update_warmup: steps over which that interval grows from 2 to `update_every`, as nerfstudio's does; there the
            option `proposal_update_every` is one less than the longest interval.
        anneal_steps: steps until a is 1; 0: it always is.
        anneal_slope: slope of a(x) at x = 0.
        padding: added to every weight before drawing.
        levels, base_resolution, max_resolutions, log2_table_size, features: of the networks' hash grids; there is one
            finest resolution for each network.
        hidden: units of the networks' hidden layer.
    """

    def __init__(
        self,
        contraction: Contraction,
        *,
        samples: Annotated[list[Count], Len(1, 16)] = [256, 96],  # noqa: B006 (read only)
        final: Count = 48,
        spacing: str = "piecewise",
        update_every: PositiveInt = 5,
        update_warmup: Annotated[int, Interval(ge=0, le=10**6)] = 0,
        anneal_steps: NonNegativeInt = 1000,
        anneal_slope: Annotated[float, Interval(ge=1, le=10**6)] = 10.0,
        padding: NonNegativeFactor = 0.01,
        levels: Levels = 5,
        base_resolution: Resolution = 16,
        max_resolutions: list[Resolution] = [128, 256],  # noqa: B006
        log2_table_size: Log2Size = 17,
        features: EntryFeatures = 2,
        hidden: Count = 16,
    ) -> None:
        super().__init__(contraction)
        if len(samples) != len(max_resolutions):
            raise ValueError(
                f"sampler=proposal: samples and max_resolutions need one number per network, got {list(samples)} and "
                f"{list(max_resolutions)}"
            )
        SPACINGS.get(spacing)
        self.samples, self.final, self.spacing, self.padding = tuple(samples), final, spacing, padding
        self.rendered_samples = final
        self.update_every, self.anneal_steps, self.anneal_slope = update_every, anneal_steps, anneal_slope
        warmup_updates = _warmup_updates(update_every, update_warmup)
        self._warmup_updates, self._last_warmup_update = frozenset(warmup_updates), warmup_updates[-1]
        grid = {"levels": levels, "min_resolution": base_resolution, "features": features}
        self.networks = nn.ModuleList(
            ProposalNetwork(hidden, max_resolution=resolution, log2_table_size=log2_table_size, **grid)
            for resolution in max_resolutions
        )

    def phase(self, step: int) -> tuple[bool, float]:
        return self.learns(step), self.anneal(step)

    def learns(self, step: int) -> bool:
        """Whether the networks get a gradient in this step. It depends on the step alone."""
        last = self._last_warmup_update
        return step in self._warmup_updates if step <= last else (step - last) % self.update_every == 0

    def anneal(self, step: int) -> float:
        """Exponent a of the weights at this step, from 0 (even sampling) to 1."""
        if step >= self.anneal_steps:
            return 1.0
        x = step / self.anneal_steps
        return self.anneal_slope * x / ((self.anneal_slope - 1) * x + 1)

    def proposed(self, network: nn.Module, unit: Tensor, inside: Tensor | None) -> Tensor:
        """Density (R, K) of a proposal network at points (R, K, 3) of the unit cube; 0 where not `inside` (R, K)."""
        points = unit.reshape(-1, 3)
        if isinstance(network, ProposalNetwork):
            modules = (network, network.encoder)
            if serves("hash grid + MLP", points, modules=modules):
                return network.inside(points, None if inside is None else inside.reshape(-1)).view(unit.shape[:-1])
        density = network(points).view(unit.shape[:-1])
        return density if inside is None else density.masked_fill(~inside, 0)  # infinity times 0 would be NaN

    def forward(
        self, rays: Rays, density: Density, *, generator: torch.Generator | None = None, step: int = 0
    ) -> SampledRays:
        rays = rays.detach()
        learns = torch.is_grad_enabled() and self.learns(step)
        jitters = draw_jitter(rays, len(self.samples) + 1, generator)
        exponent = self.anneal(step)
        space = None if learns else self.space(rays)
        if space is None:
            return self._operations(rays, jitters, exponent, learns)
        with torch.no_grad():
            s = even_edges(rays, self.samples[0], jitters[0])
        proposals = []
        for network, jitter, count in zip(self.networks, jitters[1:], (*self.samples[1:], self.final), strict=True):
            assert isinstance(network, ProposalNetwork)
            draws = Draws(count + 1, jitter, self.padding, MIN_TOTAL)
            t, weights, drawn = propose(space, s, network.parts, draws, exponent)
            proposals.append((Samples(t, s), weights))
            s = drawn
        return SampledRays(Samples(in_world(space, s), s), proposals)

    def space(self, rays: Rays) -> Space | None:
        """What the loop over a proposal takes besides its network; None: it does not know one of the components."""
        but = None if self.spacing in KNOWN_SPACINGS else f"spacing {self.spacing}"
        modules = [self.contraction, *([] if self.mask is None else [self.mask]), *self.networks]
        if not serves("proposals", rays.origins, *self.parameters(), modules=modules, but=but):
            return None
        ends = (rays.origins, rays.directions, rays.near, rays.far)
        return Space(*ends, self.spacing, *numbers_of(self.contraction), None if self.mask is None else self.mask.grid)

    def _operations(self, rays: Rays, jitters: list[Tensor | None], exponent: float, learns: bool) -> SampledRays:
        """The same, one operation after another: with gradients if the networks learn, and with any component."""
        first, *others = jitters
        proposals = []
        with torch.no_grad():
            spacing = SPACINGS.build(self.spacing, rays.near, rays.far)
            s = even_edges(rays, self.samples[0], first)
        for network, jitter, count in zip(self.networks, others, (*self.samples[1:], self.final), strict=True):
            with torch.no_grad():
                intervals = Samples(spacing.to_world(s), s)
                points = unit_points(rays, intervals, self.contraction, self.mask)
            with torch.set_grad_enabled(learns):
                weights = volume_weights(self.proposed(network, *points), intervals.deltas)
            if not learns:
                weights = weights.detach()
            proposals.append((intervals, weights))
            with torch.no_grad():
                annealed = weights if exponent == 1 else weights.pow(exponent)
                s = sample_edges(s, annealed, count + 1, padding=self.padding, jitter=jitter)
        with torch.no_grad():
            return SampledRays(Samples(spacing.to_world(s), s), proposals)


def _warmup_updates(every: int, warmup: int) -> list[int]:
    """Steps with a gradient until the interval between them is `every`, in order.

    With a warm-up they are those of nerfstudio 1.1.5, whose intervals are longer than what it counts and whose first
    steps are one more.

    >>> _warmup_updates(4, 20)
    [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 14, 17, 20, 24]
    """
    if not warmup:
        return list(range(_FIRST_STEPS))
    steps = list(range(_FIRST_STEPS + 1))
    for step in range(len(steps), warmup + 1):
        counted = min(max((every - 1) * (step - 1) / warmup, 1.0), every - 1)
        if step - steps[-1] > counted:
            steps.append(step)
    return [*steps, max(warmup + 1, steps[-1] + every)]
