"""A training step as a chain: compiled loops, called one after the other, there and back again.

    rays -> proposals -> samples -> raw values -> weights, shares -> colours -> pixels -> losses
    and from the losses back to the gradient of each parameter

Every loop works on buffers that are made once. The heads are islands: a head takes features and returns values, and on
the way back it takes their gradients and returns those of its features. In between it is any module under autograd. An
MLP on a hash grid is no island: one loop computes both.

`to_x` is the gradient of the loss by x. `self._x` is a loop with its buffers: to call it fills them.

`Trainer` takes this way where `Chain.serves`. Else autograd goes through the same loops one by one, with the same
numbers up to rounding.
"""

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from qnerf.config.settings import Train
from qnerf.geometry.pose_refinement import FixedPoses
from qnerf.geometry.rays import RayTable
from qnerf.geometry.unit_points import numbers_of
from qnerf.heads.mlp import MLPHead
from qnerf.kernels import color_inputs, compositing, histogram, shading
from qnerf.kernels.dispatch import serves
from qnerf.kernels.grid_mlp import GridPass
from qnerf.kernels.jit import flat, prepared
from qnerf.kernels.mlp import MLPPass
from qnerf.kernels.points import places
from qnerf.kernels.proposals import KNOWN_SPACINGS, Proposal, in_world
from qnerf.model.field import evaluate_last
from qnerf.model.model import Model
from qnerf.rendering.background import background_color
from qnerf.rendering.proposal_sampler import ProposalNetwork, ProposalSampler
from qnerf.rendering.samplers import even_edges
from qnerf.rendering.shading import EverySample, MergeShading, options_of
from qnerf.timing import Stopwatch


class Chain:
    """Steps of one model: `terms`, then `backward`.

    Args:
        model: whose `parameters` are trained.
        table: of the training pixels.
        background: see `qnerf.rendering.render`.
    """

    def __init__(self, model: Model, table: RayTable, train: Train, background: str) -> None:
        self.model, self.table, self.train, self.background = model, table, train, background
        self.parameters = list(model.parameters())
        self.batch: Batch | None = None
        self._made_for: tuple[int, ...] = ()
        self.colors: Colors | None = None

    def serves(self, but: str | None = None) -> bool:
        """Whether the chain knows all components of the model. If not, every open report of loops learns why.

        Args:
            but: another reason against it, which the caller knows.
        """
        model, field, sampler = self.model, self.model.field, self.model.sampler
        options = options_of(model.shading, field.density_activation, field.initial, self.background)
        networks = list(sampler.networks) if isinstance(sampler, ProposalSampler) else []
        against = {
            "refined poses": type(model.cameras) is not FixedPoses,
            "more directions than are kept": self.table.directions is None,
            "another spacing": isinstance(sampler, ProposalSampler) and sampler.spacing not in KNOWN_SPACINGS,
            "another activation of the density": options is None,
            "parameters in another order in memory": not all(one.is_contiguous() for one in self.parameters),
            "parameters that do not learn": not all(one.requires_grad for one in self.parameters),
            "hooks on parameters": any(
                one._backward_hooks or one._post_accumulate_grad_hooks for one in self.parameters
            ),
            "autocast": torch.is_autocast_enabled("cpu"),
        }
        but = but or next((reason for reason, holds in against.items() if holds), None)
        # A module that a loop replaces is not called, so its class and its hooks count, too.
        modules = [model, field, sampler, *networks, field.contraction, model.shading, model.cameras]
        if field.mask is not None:
            modules.append(field.mask)
        if self.batch and self.batch.grid_pass:
            modules += [field.encoder, field.density_head]
        if self.colors and self.colors.mlp_pass:
            modules.append(field.color_head)
        called = [field.encoder, field.density_head, field.color_head, field.directions, field.appearance]
        return serves("whole step", self.table.poses, modules=modules, called=called, but=but)

    @torch.no_grad()
    def terms(self, streams: Mapping[str, torch.Generator], step: int, watch: Stopwatch) -> dict[str, Tensor]:
        """Draws a batch; the weighted terms of the loss."""
        if self.batch is None or self._made_for != self._places():
            self.batch = self.colors = None  # their memory is free before the new ones are made
            self.batch = Batch(self.model, self.table, self.train.rays, self.background)
            self._made_for = self._places()
        batch = self.batch
        with watch.stage("sampling"):
            batch.sample(streams, step)
        with watch.stage("field"):
            raw = batch.raw_values()
            self.colors = self.colors or Colors(self.model, batch, raw, self.train, self.background)
            self.colors.forward()
        with watch.stage("render"):
            return self.colors.losses(streams["samples"], batch.learns, watch.active)

    @torch.no_grad()
    def backward(self) -> None:
        """Writes the gradients of all parameters that the last `terms` depend on."""
        assert self.batch
        assert self.colors
        if self.batch.learns and self.train.interlevel:
            for proposal, gradient in zip(self.batch.proposals, self.colors.to_proposed, strict=True):
                proposal.backward(flat(gradient))
        self.batch.backward(self.colors.backward())

    def _places(self) -> tuple[int, ...]:
        """Where in memory everything lies that buffers are made for."""
        mask = self.model.field.mask
        return (*(one.data_ptr() for one in self.parameters), 0 if mask is None else mask.grid.data_ptr())


class Batch:
    """The first half of a chain: a batch of R rays -> proposals -> K samples on each -> raw values."""

    def __init__(self, model: Model, table: RayTable, rays: int, background: str) -> None:
        sampler, field = model.sampler, model.field
        assert isinstance(sampler, ProposalSampler)
        self.sampler, self.field, self.table, self.last = sampler, field, table, background == "last_sample"
        # A batch.
        self.numbers = torch.empty(rays, dtype=torch.int64)
        self.rays, self.pixels = table.empty_batch(rays)
        self._gather = table.gather(self.numbers, self.rays, self.pixels)
        # Each proposal network draws the edges of the next one, and the last one those of the samples.
        new, counts = table.poses.new_empty, (*sampler.samples, sampler.final)
        space = sampler.space(self.rays)
        assert space
        self.jitters = new(len(counts), rays, 1)
        self.even = s = new(rays, counts[0] + 1)
        self.proposals: list[Proposal] = []
        for network, (_, following), jitter in zip(sampler.networks, pairwise(counts), self.jitters[1:], strict=True):
            assert isinstance(network, ProposalNetwork)
            self.proposals.append(Proposal(space, s, network.parts, sampler.draws(following, jitter)))
            s = self.proposals[-1].drawn
        self.spacing, self.edges = s, new(s.shape)
        self._in_world = in_world(space, s, self.edges)
        # The samples in the unit cube; which are inside the mask; which have raw values, as a ray's last one may, too,
        # for its colour; and the network on the hash grid.
        shape, mask = (rays, sampler.final), field.mask
        self.unit = new(*shape, 3)
        self.inside = None if mask is None else torch.empty(shape, dtype=torch.bool)
        self.evaluated = None if self.inside is None else torch.empty_like(self.inside)
        ends = (self.rays.origins, self.rays.directions, self.edges, *numbers_of(field.contraction))
        self._place = places(*ends, None if mask is None else mask.grid, self.unit, self.inside)
        points, where = self.unit.view(-1, 3), None if self.evaluated is None else self.evaluated.view(-1)
        network_on_grid = field.on_grid(points)
        self.grid_pass = None if network_on_grid is None else GridPass(points, where, network_on_grid)
        self.raw: Tensor | None = None if self.grid_pass is None else self.grid_pass.values.view(*shape, -1)

    def sample(self, streams: Mapping[str, torch.Generator], step: int) -> None:
        """Draws a batch and its samples."""
        self.table.draw(self.numbers, streams["pixels"])
        self._gather()
        self.learns = self.sampler.learns(step)
        torch.rand(self.jitters.shape, dtype=self.jitters.dtype, generator=streams["samples"], out=self.jitters)
        even_edges(self.rays, self.sampler.samples[0], self.jitters[0], out=self.even)
        anneal = self.sampler.anneal(step)
        for proposal in self.proposals:
            proposal.forward(anneal, self.learns)
        self._in_world()

    def raw_values(self) -> Tensor:
        """Raw values (R, K, 1 + G) of the samples, each time in the same memory."""
        self._place()
        if self.evaluated is not None and self.inside is not None:
            self.evaluated.copy_(self.inside)
            evaluate_last(self.evaluated, self.last)
        if self.grid_pass is not None and self.raw is not None:
            self.grid_pass.forward()
            return self.raw
        return self._raw_of_island()

    def _raw_of_island(self) -> Tensor:
        points = self.unit.view(-1, 3)
        self.rows = slice(None) if self.evaluated is None else self.evaluated.flatten().nonzero()[:, 0]
        with torch.enable_grad():
            self.values = self.field.density_head(self.field.encoder(points[self.rows]))
        if self.raw is None:  # only now is it known how many there are
            self.raw = points.new_zeros(*self.unit.shape[:2], self.values.shape[1])
        if self.evaluated is not None:
            self.raw.zero_()
        self.raw.view(len(points), -1)[self.rows] = self.values.detach().to(self.raw.dtype)
        return self.raw

    def backward(self, to_raw: Tensor) -> None:
        """Writes the gradients of the encoder and of the density head."""
        if self.grid_pass is not None:
            self.grid_pass.backward(to_raw)
        else:
            through_island(self.values, to_raw.flatten(0, 1)[self.rows])


class Colors:
    """The second half of a chain: raw values -> weights and shares -> colours -> losses."""

    def __init__(self, model: Model, batch: Batch, raw: Tensor, train: Train, background: str) -> None:
        field, way = model.field, model.shading
        assert isinstance(way, EverySample | MergeShading)
        options = options_of(way, field.density_activation, field.initial, background)
        assert options
        self.field, self.way, self.batch, self.train, self.background = field, way, batch, train, background
        # Weights, shares, and the mean geometry of the points that may get a colour.
        self.to_raw, self.deltas = torch.empty_like(raw), raw.new_empty(raw.shape[:2])
        self.shaded = kept = shading.Buffers.of(raw, options)
        given = [torch.empty_like(one) for one in (kept.weights, kept.shares, kept.mean)]
        self.to_weights, self.to_shares, self.to_mean = given
        shaded = (raw, batch.inside, self.deltas, options, kept)
        self._shade = shading.shade(*shaded)
        self._shade_gradient = shading.shade_gradient(*shaded, given, self.to_raw)
        # What the colour head gets for each point that was chosen, in rows of as many as there can be.
        rays, points, features = kept.mean.shape
        self.chosen = torch.ones(rays, points, dtype=torch.bool)
        self.ends = np.arange(points, rays * points + 1, points)  # up to which row each ray goes
        width = field.of_rays(batch.rays.directions, batch.rays.cameras).shape[1]
        self.of_rays, self.to_rays = raw.new_empty(2, rays, width).unbind()
        self.rows = raw.new_empty(rays * points, width + features)
        self._rows = color_inputs.gather(self.of_rays, kept.mean, self.chosen, self.ends, self.rows)
        self._rows_gradient = color_inputs.gather_gradient(self.chosen, self.ends, self.to_rays, self.to_mean)
        layers = field.color_head.in_loop(self.rows) if isinstance(field.color_head, MLPHead) else None
        self.mlp_pass = None if layers is None else MLPPass(self.rows, layers)
        self.to_rows = torch.empty_like(self.rows)
        # The pixels, and the losses with their gradients.
        self.behind = raw.new_empty(rays if self.background != "last_sample" else 0, 3)
        self.to_colors, self.squares = raw.new_empty(rays * points, 3), np.empty(rays)
        written = (self.squares, self.to_colors, self.to_shares, self.to_weights)
        shares = (kept.shares, kept.weights, self.chosen, self.ends, batch.pixels, self.behind)
        sizes = (points, raw.shape[1])
        self._composite = prepared(compositing.composite, rays, *sizes, *shares, *written, grain=compositing.GRAIN)
        self.ray_losses, self.distortion_gradient = np.empty(rays), torch.empty_like(kept.weights)
        self._distortion = histogram.distortion(kept.weights, batch.spacing, self.ray_losses, self.distortion_gradient)
        self.to_proposed = [torch.empty_like(proposal.weights) for proposal in batch.proposals]
        self._interlevel = [
            histogram.interlevel(proposal.weights, batch.spacing, kept.weights, proposal.s, self.ray_losses, to)
            for proposal, to in zip(batch.proposals, self.to_proposed, strict=True)
        ]

    def forward(self) -> None:
        """Colours (N, 3) of the chosen points."""
        batch, field = self.batch, self.field
        torch.sub(batch.edges[:, 1:], batch.edges[:, :-1], out=self.deltas)
        self._shade()
        chosen = self.way.chosen(self.shaded.shares, batch.evaluated)
        if chosen is not None:
            self.chosen.copy_(chosen)
            np.cumsum(np.count_nonzero(self.chosen.numpy(), axis=1), out=self.ends)
        with torch.set_grad_enabled(field.appearance is not None):
            self.ray_features = field.of_rays(batch.rays.directions, batch.rays.cameras)
        self.of_rays.copy_(self.ray_features)
        self._rows()
        count = int(self.ends[-1])
        self.inputs = self.rows[:count].requires_grad_()
        with torch.enable_grad():
            if self.mlp_pass is None:
                self.raw_colors = field.color_head(self.inputs)
            else:
                self.raw_colors = self.mlp_pass.forward(count).requires_grad_()
            self.values = field.activated_color(self.raw_colors)

    def losses(self, generator: torch.Generator, learns: bool, logs: bool) -> dict[str, Tensor]:
        """The terms, and their gradients by colours, shares and weights, and by the weights of the proposals."""
        train, weights = self.train, self.shaded.weights
        behind = background_color(self.background, weights, generator)
        if behind is not None:
            self.behind.copy_(behind)
        self._composite(flat(self.values.to(weights.dtype)))
        terms = {"mse": self.squares.sum() / (3 * len(self.squares))}
        if train.distortion:
            scale = train.distortion / len(weights)
            self._distortion()
            terms["distortion"] = scale * self.ray_losses.sum()
            self.to_weights.add_(self.distortion_gradient, alpha=scale)
        # In steps in which the proposal networks do not learn, their loss is computed only to be logged.
        if train.interlevel and (learns or logs):
            scale = train.interlevel / weights.numel()
            terms["interlevel"] = 0.0
            for loss, gradient in zip(self._interlevel, self.to_proposed, strict=True):
                loss()
                terms["interlevel"] += scale * self.ray_losses.sum()
                gradient.mul_(scale)
        return {name: weights.new_tensor(term) for name, term in terms.items()}

    def backward(self) -> Tensor:
        """The gradient of the raw values; those of the colour head's parameters on the way."""
        through_island(self.values, self.to_colors[: len(self.inputs)])
        if self.mlp_pass is not None and self.raw_colors.grad is not None:
            to_rows = self.to_rows
            self.mlp_pass.backward(self.raw_colors.grad, to_rows)
        elif self.inputs.grad is not None:
            to_rows = self.inputs.grad
        else:  # the head does not depend on them
            to_rows = torch.zeros_like(self.inputs)
        self._rows_gradient(flat(to_rows))
        through_island(self.ray_features, self.to_rays)
        self._shade_gradient()
        return self.to_raw


def through_island(values: Tensor, gradient: Tensor) -> None:
    """Takes the gradient of an island's values back through it, if anything in it or before it learns."""
    if values.requires_grad:
        with torch.enable_grad():
            values.backward(gradient.to(values.dtype).view_as(values))
