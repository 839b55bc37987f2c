"""Where along a ray colours are computed.

The colour head is the costliest part of a field, above all when it is a circuit, and the samples that decide a ray's
colour lie close together. Samples whose density was not evaluated have weight 0 and never get a colour.
"""

from typing import Annotated, NamedTuple

import torch
from annotated_types import Interval
from torch import Tensor, nn

from qnerf.config.bounds import Count
from qnerf.config.registry import Registry
from qnerf.heads.base import MIN_BATCH
from qnerf.kernels.dispatch import serves
from qnerf.kernels.merging import Merge

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

    def forward(self, shares: Tensor, geometry: Tensor, evaluated: Tensor | None = None) -> Shaded:
        raise NotImplementedError


@SHADINGS.register("none")
class EverySample(Shading):
    """Every evaluated sample gets a colour."""

    def forward(self, shares: Tensor, geometry: Tensor, evaluated: Tensor | None = None) -> Shaded:
        return Shaded(shares, geometry, evaluated)


class Selection(Shading):
    """Some samples get a colour, at least one per ray that has any. They take over the weight of the others."""

    def select(self, shares: Tensor) -> Tensor:
        """Shares (R, K), -1 where a sample was not evaluated -> which samples get a colour (R, K)."""
        raise NotImplementedError

    def forward(self, shares: Tensor, geometry: Tensor, evaluated: Tensor | None = None) -> Shaded:
        with torch.no_grad():
            ranked = shares if evaluated is None else shares.masked_fill(~evaluated, -1)
            mask = self.select(ranked) & (ranked >= 0)
            if int(mask.sum()) < MIN_BATCH:  # nearly all rays are empty
                mask = ranked >= 0
        selected = shares * mask
        total = shares.sum(-1, keepdim=True)
        scale = total / selected.sum(-1, keepdim=True).clamp(min=torch.finfo(shares.dtype).tiny)
        return Shaded(selected * scale, geometry, mask)


@SHADINGS.register("threshold")
class ThresholdShading(Selection):
    """Samples whose share is at least `min_share`; the others of a ray sum to less than K `min_share`.

    Args:
        min_share: share of a ray's colour, 0 to 1.
    """

    def __init__(self, *, min_share: Annotated[float, Interval(ge=0, lt=1)] = 1e-3) -> None:
        super().__init__()
        self.min_share = min_share

    def select(self, shares: Tensor) -> Tensor:
        return shares >= shares.amax(-1, keepdim=True).clamp(max=self.min_share)


@SHADINGS.register("top")
class TopShading(Selection):
    """The samples with the largest shares of each ray.

    Args:
        samples: number per ray.
    """

    def __init__(self, *, samples: Count = 8) -> None:
        super().__init__()
        self.samples = samples

    def select(self, shares: Tensor) -> Tensor:
        count = min(self.samples, shares.shape[-1])
        return torch.zeros_like(shares, dtype=torch.bool).scatter_(-1, shares.topk(count, dim=-1).indices, True)


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
        if serves("merging samples", shares, geometry):
            merged, mean = Merge.apply(shares, geometry, self.parts, SMALL / self.parts, merge_reference)
        else:
            merged, mean = merge_reference(shares, geometry, self.parts)
        mask = merged > 0
        if int(mask.sum()) < MIN_BATCH:  # all rays are empty
            mask[:, 0] = True
        return Shaded(merged, mean, mask)


def merge_reference(shares: Tensor, geometry: Tensor, parts: int) -> tuple[Tensor, Tensor]:
    """Shares (R, M) and mean geometry (R, M, G) of `MergeShading`'s parts in plain PyTorch."""
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
