"""Points and view directions -> density and colour: contraction, encoder, density head, colour head."""

from collections.abc import Callable

import torch
from torch import Tensor, nn

from qnerf.contraction import Contraction
from qnerf.encoders import Encoder
from qnerf.visibility import SpaceMask


class Field(nn.Module):
    """A radiance field. Which kind of heads it was given, it does not ask.

    Args:
        contraction: world points (..., 3) -> the unit cube (..., 3).
        encoder: unit-cube points (N, 3) -> features (N, F).
        directions: unit view directions (R, 3) -> features (R, D).
        density: head (N, F) -> (N, 1 + G): density before its activation, and G geometry features.
        color: head (N, D + G + A) -> (N, 3): colour before the sigmoid.
        activation: raw density -> density >= 0.
        initial: density of a head that puts out 0 under `trunc_exp`, per world unit.
        views: training views, for the appearance embedding.
        appearance: size A of the appearance embedding; 0 for none.
    """

    def __init__(
        self,
        contraction: Contraction,
        encoder: Encoder,
        directions: nn.Module,
        density: nn.Module,
        color: nn.Module,
        activation: Callable[[Tensor], Tensor],
        initial: float,
        views: int,
        appearance: int,
    ) -> None:
        super().__init__()
        self.contraction = contraction
        self.encoder = encoder
        self.directions = directions
        self.density_head = density
        self.color_head = color
        self.activation = activation
        self.initial = initial
        self.appearance = nn.Embedding(views, appearance) if appearance else None
        self.mask: SpaceMask | None = None
        """Where density may be; None for everywhere."""

    def geometry(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """World points (R, K, 3) -> density (R, K) per world unit and geometry features (R, K, G)."""
        shape = points.shape[:-1]
        unit = self.contraction(points)
        encoded = self.encoder(unit.reshape(-1, 3))
        raw = self.density_head(encoded).view(*shape, -1)
        density = self.activation(raw[..., 0])
        if self.initial != 1.0:
            density = density * self.initial
        if self.mask is not None:
            density = density * self.mask(unit)
        return density, raw[..., 1:]

    def density(self, points: Tensor) -> Tensor:
        """World points (R, K, 3) -> density (R, K) per world unit."""
        return self.geometry(points)[0]

    def color(self, geometry: Tensor, directions: Tensor, cameras: Tensor, kept: Tensor | None = None) -> Tensor:
        """Geometry features (R, K, G), unit directions (R, 3), views (R,) -> colours (R, K, 3) in [0, 1].

        A view of -1 is one without an embedding of its own: it gets the mean of all. `kept` (R, K): the samples to
        evaluate; the others are black.
        """
        per_ray = [self.directions(directions)]
        if self.appearance is not None:
            own = self.appearance(cameras.clamp(min=0))
            per_ray.append(torch.where((cameras >= 0)[:, None], own, self.appearance.weight.mean(0)))
        rays, samples, size = geometry.shape
        ray_features = torch.cat(per_ray, dim=-1)
        if kept is None:
            expanded = ray_features[:, None, :].expand(-1, samples, -1)
            features = torch.cat([expanded, geometry], dim=-1)
            return torch.sigmoid(self.color_head(features.reshape(rays * samples, -1))).view(rays, samples, 3)
        chosen = kept.flatten().nonzero()[:, 0]
        ray = torch.div(chosen, samples, rounding_mode="floor")
        features = torch.cat([ray_features[ray], geometry.reshape(-1, size)[chosen]], dim=-1)
        color = torch.sigmoid(self.color_head(features))
        return color.new_zeros(rays * samples, 3).index_copy(0, chosen, color).view(rays, samples, 3)

    def forward(self, points: Tensor, directions: Tensor, cameras: Tensor) -> tuple[Tensor, Tensor]:
        """World points (R, K, 3), unit directions (R, 3), views (R,) -> density (R, K), colours (R, K, 3) in [0, 1]."""
        density, geometry = self.geometry(points)
        return density, self.color(geometry, directions, cameras)
