"""World space <-> the unit cube: unbounded scenes are contracted into a cube or ball, bounded ones are scaled."""

from typing import Annotated, Literal, get_args

import torch
from annotated_types import Interval
from torch import Tensor, nn

from qnerf.config import bounds
from qnerf.config.registry import Registry
from qnerf.config.tensors import returned

CONTRACTIONS: Registry["Contraction"] = Registry("contraction")
Order = Literal["linf", "l2"]
ORDERS: tuple[str, ...] = get_args(Order)


def contract(points: Tensor, order: str = "linf") -> Tensor:
    """World points (..., 3) -> [-2, 2]^3: x if |x| <= 1, else (2 - 1/|x|) x/|x| (Eq. 10, arXiv:2111.12077).

    The map and its first derivative are continuous (linf: except on the cube's diagonals). Infinite coordinates are
    clamped to a quarter of the largest finite number and have gradient 0. A NaN coordinate makes all three NaN. All
    other gradients are finite. Derivatives are accurate relative to the largest one, about 1/|x|; the radial
    derivative, 1/|x|^2, has no correct digits beyond |x| = 1/eps.

    >>> contract(torch.tensor([[0.5, 0.0, 0.0], [4.0, 0.0, 0.0]])).tolist()
    [[0.5, 0.0, 0.0], [1.75, 0.0, 0.0]]

    Args:
        order: the norm: "linf" fills the cube, "l2" the ball of radius 2.
    """
    largest = torch.finfo(points.dtype).max / 4  # room for the sum in an l2 norm
    points = points.clamp(-largest, largest)
    norm = _norm(points, order)
    return points / norm * (2 - 1 / norm)


def uncontract(points: Tensor, order: str = "linf") -> Tensor:
    """Inverse of `contract`: (..., 3) of norm below 2 -> world points. Norms of 2 and above map to norm 1 / eps.

    >>> uncontract(torch.tensor([1.75, 0.0, 0.0])).tolist()
    [4.0, 0.0, 0.0]
    """
    norm = _norm(points, order)
    return points / norm / (2 - norm).clamp(min=torch.finfo(points.dtype).eps)


def _norm(points: Tensor, order: str) -> Tensor:
    """The norm (..., 1), at least 1: with norm 1, (2 - 1/|x|) x/|x| is the identity."""
    if order == "linf":
        x, y, z = points.abs().split(1, dim=-1)  # faster than a reduction over three numbers
        return torch.maximum(torch.maximum(x, y), z).clamp(min=1)
    bounds.check("contraction order", order, Order)
    with torch.no_grad():  # the square of 1e30 is infinite in float32
        scale = _norm(points, "linf")
    return (torch.linalg.vector_norm(points / scale, dim=-1, keepdim=True) * scale).clamp(min=1)


class Contraction(nn.Module):
    """World points (..., 3) -> the unit cube (..., 3); `inverse` maps back."""

    bounded = False
    """Whether the unit cube is only a part of the world, so that some points fall outside it."""

    def __call__(self, points: Tensor) -> Tensor:
        return returned(self, super().__call__(points), points.shape, points)

    def forward(self, points: Tensor) -> Tensor:
        raise NotImplementedError

    def inverse(self, unit: Tensor) -> Tensor:
        raise NotImplementedError


class _Norm(Contraction):
    order: str

    def forward(self, points: Tensor) -> Tensor:
        return (contract(points, self.order) + 2) / 4

    def inverse(self, unit: Tensor) -> Tensor:
        return uncontract(4 * unit - 2, self.order)


@CONTRACTIONS.register("linf")
class CubeContraction(_Norm):
    """All of space into the unit cube, by the largest coordinate. [-1, 1]^3 fills the middle half of each axis."""

    order = "linf"


@CONTRACTIONS.register("l2")
class BallContraction(_Norm):
    """All of space into the ball inside the unit cube, by the distance from the origin."""

    order = "l2"


@CONTRACTIONS.register("box")
class Box(Contraction):
    """The box [-h, h]^3 onto the unit cube, for bounded scenes. Points outside the box map outside the unit cube.

    >>> Box(half_extent=2.0)(torch.tensor([-2.0, 0.0, 4.0])).tolist()
    [0.0, 0.5, 1.5]

    Args:
        half_extent: h, in world units.
    """

    bounded = True

    def __init__(self, *, half_extent: Annotated[float, Interval(ge=1e-6, le=10**6)] = 1.0) -> None:
        super().__init__()
        self.half_extent = half_extent

    def forward(self, points: Tensor) -> Tensor:
        return points / (2 * self.half_extent) + 0.5

    def inverse(self, unit: Tensor) -> Tensor:
        return (unit - 0.5) * (2 * self.half_extent)
