"""The whole model: rays -> samples -> field -> render."""

import torch
from torch import Tensor, nn

from qnerf.geometry.pose_refinement import PoseRefinement
from qnerf.geometry.unit_points import unit_points
from qnerf.model.field import Field
from qnerf.rendering.render import render
from qnerf.rendering.samplers import SampledRays, Sampler
from qnerf.rendering.shading import Shading, shade
from qnerf.timing import Stopwatch
from qnerf.types import Rays, Rendering


class Model(nn.Module):
    """Field, sampler, pose refinement and shading as one module."""

    def __init__(self, field: Field, sampler: Sampler, cameras: PoseRefinement, shading: Shading) -> None:
        super().__init__()
        self.field = field
        self.sampler = sampler
        self.cameras = cameras
        self.shading = shading

    @property
    def parts(self) -> dict[str, list[nn.Parameter]]:
        """The parameters, grouped as they are counted and optimised (see `train.rates`)."""
        modules = {
            "encoder": self.field.encoder,
            "density": self.field.density_head,
            "color": self.field.color_head,
            "sampler": self.sampler,
            "cameras": self.cameras,
        }
        parts = {name: list(module.parameters()) for name, module in modules.items()}
        embedding = self.field.appearance
        parts["appearance"] = [] if embedding is None else list(embedding.parameters())
        assert sum(map(len, parts.values())) == len(list(self.parameters())), "a parameter belongs to no part"
        return parts

    def forward(
        self,
        rays: Rays,
        *,
        background: str,
        step: int,
        watch: Stopwatch,
        generator: torch.Generator | None = None,
    ) -> tuple[Rendering, SampledRays, Tensor | None]:
        """Renders R rays.

        Args:
            background: last_sample, white, black or random.
            step: optimisation step from 0, for schedules.
            watch: times the stages.
            generator: of jitter and random backgrounds; None: deterministic, as in evaluation.

        Returns:
            The rendering; the samples, which the regularisers need; and the background colours (R, 3) on which a target
            with alpha must be composited, None for last_sample.
        """
        with watch.stage("sampling"):
            sampled = self.sampler(rays, self.field.density, generator=generator, step=step)
        samples = sampled.samples
        with watch.stage("field"):
            points = unit_points(rays, samples, self.field.contraction, self.field.mask)
            raw, evaluated = self.field.raw_at(*points, last=background == "last_sample")
            density = (self.field.density_activation, self.field.initial)
            weights, shaded = shade(raw, points[1], evaluated, samples.deltas, *density, background, self.shading)
            color = self.field.color(shaded.geometry, rays.directions, rays.cameras, shaded.mask)
        with watch.stage("render"):
            rendering, behind = render(
                weights, color, samples, background=background, shares=shaded.shares, generator=generator
            )
        return rendering, sampled, behind
