"""Points and view directions -> density and colour: contraction, encoder, density head, colour head."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from qnerf.config.tensors import returned
from qnerf.encoders import Encoder, HashEncoder
from qnerf.geometry.contraction import Contraction
from qnerf.geometry.visibility import SpaceMask
from qnerf.heads.base import MIN_BATCH
from qnerf.heads.mlp import MLPHead
from qnerf.kernels.dispatch import serves
from qnerf.kernels.grid_mlp import Grid, grid_mlp
from qnerf.kernels.mlp import Layer
from qnerf.model.chosen_rows import at_rows
from qnerf.rendering.shading import activated


class Field(nn.Module):
    """A radiance field with any kind of heads, classical or quantum.

    Args:
        contraction: world points (..., 3) -> the unit cube (..., 3).
        encoder: unit-cube points (N, 3) -> features (N, F).
        directions: unit view directions (R, 3) -> features (R, D).
        density: head (N, F) -> (N, 1 + G): raw density, and G geometry features.
        color: head (N, D + G + A) -> (N, 3): raw colour.
        density_activation: raw density -> density >= 0.
        color_activation: raw colour -> colour.
        initial: factor on the density: with `trunc_exp`, the density per world unit of a head that returns 0.
        views: number of views of the scene, held-out ones included.
        trained: indices of the training views, which learn an appearance.
        appearance: size A of the appearance embedding; 0: none.
    """

    def __init__(
        self,
        contraction: Contraction,
        encoder: Encoder,
        directions: nn.Module,
        density: nn.Module,
        color: nn.Module,
        density_activation: Callable[[Tensor], Tensor],
        color_activation: Callable[[Tensor], Tensor],
        initial: float,
        views: int,
        trained: Sequence[int],
        appearance: int,
    ) -> None:
        super().__init__()
        self.contraction = contraction
        self.encoder = encoder
        self.directions = directions
        self.density_head = density
        self.color_head = color
        self.density_activation = density_activation
        self.color_activation = color_activation
        self.initial = initial
        self.appearance = nn.Embedding(views, appearance) if appearance else None
        self.trained: Tensor
        self.register_buffer("trained", torch.tensor(trained), persistent=False)
        self.mask: SpaceMask | None = None
        """Where density may be; None: everywhere."""

    def geometry(self, points: Tensor, *, last: bool = True) -> tuple[Tensor, Tensor, Tensor | None]:
        """Density and geometry features of R rays.

        With a mask, samples where density is impossible are not evaluated: their density and features are 0.

        Args:
            points: (R, K, 3) world units.
            last: always evaluate each ray's last sample, whose colour can be the background.

        Returns:
            Density (R, K) per world unit, features (R, K, G), and which samples were evaluated, (R, K) bool; None: all.
        """
        unit = self.contraction(points)
        inside = None if self.mask is None else self.mask(unit)
        raw, evaluated = self.raw_at(unit, inside, last=last)
        return self.activated(raw[..., 0], inside), raw[..., 1:], evaluated

    def raw_at(self, unit: Tensor, inside: Tensor | None, *, last: bool = True) -> tuple[Tensor, Tensor | None]:
        """Raw density and geometry (R, K, 1 + G), and which samples were evaluated, as `geometry` returns them.

        Args:
            unit: (R, K, 3) in the unit cube.
            inside: (R, K) bool, which points are in the mask; None: there is no mask.
        """
        shape = unit.shape[:-1]
        points = unit.reshape(-1, 3)
        evaluated = None if inside is None else evaluate_last(inside.clone(), last)
        network = self.on_grid(points)
        if network is not None:
            values = grid_mlp(points, None if evaluated is None else evaluated.flatten(), *network)
            return values.view(*shape, -1), evaluated
        if evaluated is None:
            return self.density_head(self.encoder(points)).view(*shape, -1), None

        def rows(index: Tensor | None) -> Tensor:
            return self.density_head(self.encoder(points if index is None else points[index]))

        return at_rows(self.density_head, rows, evaluated), evaluated

    def on_grid(self, points: Tensor) -> tuple[Grid, list[Layer]] | None:
        """The arguments of the loop that computes encoder and density head together; None: the two are called."""
        encoder, head = self.encoder, self.density_head
        if not isinstance(encoder, HashEncoder) or not isinstance(head, MLPHead):
            return None
        grid, layers = encoder.as_grid(), head.as_layers()
        but = "not linear layers with biases and ReLU between them" if layers is None else None
        but = "mixed precision" if head.mixed else but
        but = "the points need a gradient" if points.requires_grad else but
        if not serves("hash grid + MLP", points, modules=(encoder, head), but=but):
            return None
        assert layers is not None
        return grid, layers

    def activated(self, raw: Tensor, inside: Tensor | None = None) -> Tensor:
        """Raw density -> density per world unit, 0 where not `inside`."""
        return activated(raw, inside, self.density_activation, self.initial)

    def density(self, points: Tensor) -> Tensor:
        """World points (R, K, 3) -> density (R, K) per world unit, in evaluation mode.

        Batch normalisation must collect its statistics from rendered samples only.
        """
        training = self.density_head.training
        self.density_head.eval()
        try:
            return self.geometry(points, last=False)[0]
        finally:
            self.density_head.train(training)

    def of_rays(self, directions: Tensor, cameras: Tensor) -> Tensor:
        """Features (R, D + A) that all points of a ray share: its direction's, and the appearance of its view."""
        per_ray = [self.directions(directions)]
        if self.appearance is not None:
            own = self.appearance(cameras.clamp(min=0))
            mean = self.appearance.weight[self.trained].mean(0)
            per_ray.append(torch.where((cameras >= 0)[:, None], own, mean))
        return torch.cat(per_ray, dim=-1) if len(per_ray) > 1 else per_ray[0]

    def color(self, geometry: Tensor, directions: Tensor, cameras: Tensor, mask: Tensor | None = None) -> Tensor:
        """Colours (R, K, 3), in [0, 1] if the activation bounds them.

        Args:
            geometry: (R, K, G) features.
            directions: (R, 3) unit vectors.
            cameras: (R,) int64 views; -1, a view without an appearance embedding, gets the mean of the trained ones.
            mask: (R, K) bool, samples to evaluate; the others are black. None: all.
        """
        of_rays = self.of_rays(directions, cameras)
        count = geometry.shape[1]

        def rows(index: Tensor | None) -> Tensor:
            if index is None:
                features = torch.cat([of_rays[:, None, :].expand(-1, count, -1), geometry], dim=-1).flatten(0, 1)
            else:
                ray = torch.div(index, count, rounding_mode="floor")
                features = torch.cat([of_rays[ray], geometry.flatten(0, 1)[index]], dim=-1)
            return self.activated_color(self.color_head(features))

        return rows(None).view(*geometry.shape[:2], 3) if mask is None else at_rows(self.color_head, rows, mask)

    def activated_color(self, raw: Tensor) -> Tensor:
        """Raw colours (N, 3) -> colours (N, 3)."""
        color: Tensor = returned(self.color_activation, self.color_activation(raw), (len(raw), 3), raw)
        return color

    def forward(self, points: Tensor, directions: Tensor, cameras: Tensor) -> tuple[Tensor, Tensor]:
        """World points (R, K, 3), unit directions (R, 3), views (R,) -> density (R, K), colours (R, K, 3)."""
        density, geometry, _ = self.geometry(points)
        return density, self.color(geometry, directions, cameras)


def evaluate_last(inside: Tensor, last: bool) -> Tensor:
    """Adds each ray's `last` sample to those (R, K) whose density is computed; also where they are too few."""
    if last:
        inside[:, -1] = True
    else:
        inside[:, -1].logical_or_(inside.sum() < MIN_BATCH)
    return inside
