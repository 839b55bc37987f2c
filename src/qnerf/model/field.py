"""Points and view directions -> density and colour: contraction, encoder, density head, colour head."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from qnerf.encoders import Encoder
from qnerf.geometry.contraction import Contraction
from qnerf.geometry.visibility import SpaceMask

LEAST = 2  # samples of a batch that heads are given at least: what a normalisation needs


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
        views: of the scene, held-out ones as well, which are numbered alike.
        trained: numbers of the training views, which learn an appearance.
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
        trained: Sequence[int],
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
        self.trained: Tensor
        self.register_buffer("trained", torch.tensor(trained), persistent=False)
        self.mask: SpaceMask | None = None
        """Where density may be; None for everywhere."""

    def geometry(self, points: Tensor, *, last: bool = True) -> tuple[Tensor, Tensor, Tensor | None]:
        """World points (R, K, 3) -> density (R, K) per world unit, features (R, K, G), samples evaluated (R, K).

        With a mask those are the ones where density may be, and with `last` each ray's last, whose colour can stand for
        all that lies behind; the others have density 0 and features 0. None: all.
        """
        shape = points.shape[:-1]
        unit = self.contraction(points)
        if self.mask is None:
            raw = self.density_head(self.encoder(unit.reshape(-1, 3))).view(*shape, -1)
            return self._activated(raw[..., 0]), raw[..., 1:], None
        inside = self.mask(unit)
        evaluated = inside.clone()
        if last or int(inside.sum()) < LEAST:
            evaluated[:, -1] = True
        chosen = evaluated.flatten().nonzero()[:, 0]
        raw = self.density_head(self.encoder(unit.reshape(-1, 3)[chosen]))
        density = spread(self._activated(raw[:, 0]), chosen, shape).masked_fill(~inside, 0)
        return density, spread(raw[:, 1:], chosen, shape), evaluated

    def _activated(self, raw: Tensor) -> Tensor:
        density = self.activation(raw)
        return density if self.initial == 1.0 else density * self.initial

    def density(self, points: Tensor) -> Tensor:
        """World points (R, K, 3) -> density (R, K) per world unit, as in evaluation: what a normalisation learns of its
        inputs, it learns of samples that are rendered."""
        training = self.density_head.training
        self.density_head.eval()
        try:
            return self.geometry(points, last=False)[0]
        finally:
            self.density_head.train(training)

    def density_anywhere(self, unit: Tensor) -> Tensor:
        """Unit-cube points (N, 3) -> density (N,) per world unit, also where the mask has none."""
        return self._activated(self.density_head(self.encoder(unit))[:, 0])

    def color(self, geometry: Tensor, directions: Tensor, cameras: Tensor, kept: Tensor | None = None) -> Tensor:
        """Geometry features (R, K, G), unit directions (R, 3), views (R,) -> colours (R, K, 3) in [0, 1].

        A view of -1 is one without an embedding of its own: it gets the mean of those that are trained. `kept` (R, K):
        those to evaluate; the others are black.
        """
        per_ray = [self.directions(directions)]
        if self.appearance is not None:
            own = self.appearance(cameras.clamp(min=0))
            mean = self.appearance.weight[self.trained].mean(0)
            per_ray.append(torch.where((cameras >= 0)[:, None], own, mean))
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
        return spread(color, chosen, kept.shape)

    def forward(self, points: Tensor, directions: Tensor, cameras: Tensor) -> tuple[Tensor, Tensor]:
        """World points (R, K, 3), unit directions (R, 3), views (R,) -> density (R, K), colours (R, K, 3) in [0, 1]."""
        density, geometry, _ = self.geometry(points)
        return density, self.color(geometry, directions, cameras)


def spread(values: Tensor, chosen: Tensor, shape: torch.Size) -> Tensor:
    """Values (N, ...) of the samples with row-major numbers `chosen` (N,), among zeros: (R, K, ...)."""
    rest = values.shape[1:]
    return values.new_zeros(shape.numel(), *rest).index_copy(0, chosen, values).view(*shape, *rest)
