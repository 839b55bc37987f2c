"""Where along a ray colours are computed.

The colour head is the costliest part of a field, above all when it is a circuit, and the samples that decide a ray's
colour lie close together. Samples whose density was not evaluated have weight 0 and never get a colour.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from qnerf.config.bounds import Count
from qnerf.config.registry import Registry
from qnerf.config.tensors import require_tensor, returned
from qnerf.heads.activations import DENSITY_ACTIVATIONS
from qnerf.heads.base import MIN_BATCH
from qnerf.kernels.dispatch import serves
from qnerf.kernels.shading import KNOWN_ACTIVATIONS, SHADE, Options
from qnerf.rendering.render import color_shares, volume_weights

SHADINGS: "Registry[Shading]" = Registry("shading")

SMALL = 0.1  # of an equal part, see `MergeShading`


class Shaded(NamedTuple):
    """M points on each ray that may get a colour."""

    shares: Tensor  # (R, M) compositing weights of the colours; their sum per ray is the same as for the samples
    geometry: Tensor  # (R, M, G)
    mask: Tensor | None  # (R, M) bool: which points get a colour, the others have weight 0; None: all


class Shading(nn.Module):
    """Chooses the points of each ray that get a colour.

    `forward` takes the compositing weights `shares` (R, K) of the samples, at least 0, their `geometry` features
    (R, K, G), and which samples were `evaluated` (R, K), None for all. It works the same way in training and
    evaluation, so a head's normalisation sees the same kind of inputs in both.
    """

    def __call__(self, shares: Tensor, geometry: Tensor, evaluated: Tensor | None = None) -> Shaded:
        shaded: Shaded = super().__call__(shares, geometry, evaluated)
        chosen = returned(self, shaded.shares, (len(shares), "M"), shares)
        returned(self, shaded.geometry, (*chosen.shape, geometry.shape[-1]), geometry)
        if shaded.mask is not None:
            require_tensor(self, shaded.mask, chosen.shape, torch.bool)
        return shaded

    def forward(self, shares: Tensor, geometry: Tensor, evaluated: Tensor | None = None) -> Shaded:
        raise NotImplementedError


@SHADINGS.register("none")
class EverySample(Shading):
    """Every evaluated sample gets a colour."""

    parts = 0

    def forward(self, shares: Tensor, geometry: Tensor, evaluated: Tensor | None = None) -> Shaded:
        return Shaded(shares, geometry, evaluated)

    def chosen(self, shares: Tensor, evaluated: Tensor | None) -> Tensor | None:
        return evaluated


@SHADINGS.register("merge")
class MergeShading(Shading):
    """Neighbouring samples share one colour, computed from their mean geometry weighted by their shares.

    A ray's total share is cut into `parts` equal parts along the ray; a sample belongs to the part in which the middle
    of its share falls. No sample is left out. If the features change little across a part, so does the colour.

    The derivative of a part's mean m by a sample's share s_i is (g_i - m) / S, which grows without bound as the part's
    share S shrinks. A colour head alone gives such a part a gradient as small as S. But batch normalisation gives it
    one as large as any other part's, and 1 / S would make that the largest of all. So this derivative uses an S of at
    least `SMALL` of an equal part.

    Args:
        parts: per ray. With 1, features are rendered first and each ray gets one colour.
    """

    def __init__(self, *, parts: Count = 8) -> None:
        super().__init__()
        self.parts = parts

    def forward(self, shares: Tensor, geometry: Tensor, evaluated: Tensor | None = None) -> Shaded:
        merged, mean = merge(shares, geometry, self.parts)
        return Shaded(merged, mean, self.chosen(merged, evaluated))

    def chosen(self, shares: Tensor, evaluated: Tensor | None) -> Tensor:
        mask = shares > 0
        mask[:, 0].logical_or_(mask.sum() < MIN_BATCH)  # all rays are empty
        return mask


def merge(shares: Tensor, geometry: Tensor, parts: int) -> tuple[Tensor, Tensor]:
    """Shares (R, M) and mean geometry (R, M, G) of `MergeShading`'s parts."""
    tiny = torch.finfo(shares.dtype).tiny
    fixed = shares.detach()
    middle = (fixed.cumsum(-1) - fixed / 2) / fixed.sum(-1, keepdim=True).clamp(min=tiny)
    part = (middle * parts).long().clamp_(0, parts - 1)
    merged = shares.new_zeros(len(shares), parts).scatter_add(1, part, shares)
    own = merged.gather(1, part)  # (R, K) the share of each sample's part
    floor = SMALL / parts
    ratio = (shares / own.clamp(min=tiny)).detach()
    bounded = ratio + (shares - ratio * own) / floor  # the ratio, with a bounded derivative
    weight = torch.where(own < floor, bounded, shares / own.clamp(min=floor))
    mean = geometry.new_zeros(len(shares), parts, geometry.shape[-1])
    mean = mean.scatter_add(1, part[..., None].expand_as(geometry), weight[..., None] * geometry)
    return merged, mean


def activated(raw: Tensor, inside: Tensor | None, activation: Callable[[Tensor], Tensor], initial: float) -> Tensor:
    """Raw density -> density per world unit: `initial` times the activation, 0 where not `inside`."""
    density = returned(activation, activation(raw), raw.shape, raw)
    density = density if initial == 1.0 else density * initial
    return density if inside is None else density.masked_fill(~inside, 0)


def options_of(
    shading: Shading, activation: Callable[[Tensor], Tensor], initial: float, background: str
) -> Options | None:
    """What the compiled loop is told; None: it does not know the activation of the density."""
    known = next((name for name in KNOWN_ACTIVATIONS if DENSITY_ACTIVATIONS.get(name) is activation), None)
    parts = getattr(shading, "parts", 0)
    return Options(known, initial, background == "last_sample", parts, SMALL / max(parts, 1)) if known else None


def shade(
    raw: Tensor,
    inside: Tensor | None,
    evaluated: Tensor | None,
    deltas: Tensor,
    activation: Callable[[Tensor], Tensor],
    initial: float,
    background: str,
    shading: Shading,
) -> tuple[Tensor, Shaded]:
    """Weights (R, K) of the samples, and the points that get a colour, from a field's raw values (R, K, 1 + G).

    Args:
        inside: (R, K) bool, where density may be; None: everywhere.
        evaluated: (R, K) bool, samples that have raw values; None: all.
        deltas: (R, K) world units.
        activation, initial: see `activated`.
        background: with last_sample, a ray's last sample takes the transmittance that is left.
    """

    def reference(raw: Tensor) -> tuple[Tensor, Shaded]:
        weights = volume_weights(activated(raw[..., 0], inside, activation, initial), deltas)
        return weights, shading(color_shares(weights, background), raw[..., 1:], evaluated)

    def outputs(raw: Tensor) -> tuple[Tensor, ...]:
        weights, shaded = reference(raw)
        return weights, shaded.shares, shaded.geometry

    options = options_of(shading, activation, initial, background)
    but = None if options else "another activation of the density"
    if not serves("shading", raw, deltas, modules=(shading,), but=but):
        return reference(raw)
    assert options
    assert isinstance(shading, EverySample | MergeShading)
    weights, shares, geometry = SHADE.compiled(raw, inside, deltas, options, outputs)
    return weights, Shaded(shares, geometry, shading.chosen(shares, evaluated))
