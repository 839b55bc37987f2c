"""World space -> the unit cube: unbounded scenes are contracted into a ball or cube, bounded ones scaled."""

import torch
from torch import Tensor, nn

from qnerf.config.registry import Registry

CONTRACTIONS: Registry["Contraction"] = Registry("contraction")
ORDERS = ("linf", "l2")


def contract(points: Tensor, order: str = "linf") -> Tensor:
    """World points (..., 3) -> [-2, 2]^3: x where |x| <= 1, else (2 - 1/|x|) x/|x| (Eq. 10, arXiv:2111.12077).

    `order` is the norm: "linf" fills the cube, "l2" the ball of radius 2. Continuous with its first derivative (linf:
    off the cube's diagonals). Infinite coordinates count as the largest number and have gradient 0; a NaN makes all
    three coordinates NaN; gradients are finite everywhere else. They are known to some eps of the largest derivative,
    about 1/|x|; the one along x, 1/|x|^2, has no digits of its own left beyond |x| = 1/eps.
    """
    _check(order)
    largest = torch.finfo(points.dtype).max / 4  # room for the sum in an l2 norm
    points = points.clamp(-largest, largest)
    norm = _norm(points, order)
    return points / norm * (2 - 1 / norm)


def uncontract(points: Tensor, order: str = "linf") -> Tensor:
    """Inverse of `contract`: (..., 3) of norm below 2 -> world points. Norms of 2 and above map to norm 1 / eps."""
    _check(order)
    norm = _norm(points, order)
    return points / norm / (2 - norm).clamp(min=torch.finfo(points.dtype).eps)


def to_unit(points: Tensor) -> Tensor:
    """[-2, 2]^3 -> [0, 1]^3."""
    return (points + 2) / 4


def _check(order: str) -> None:
    if order not in ORDERS:
        raise ValueError(f"contraction: unknown order {order!r}; known: {', '.join(ORDERS)}")


def _norm(points: Tensor, order: str) -> Tensor:
    """The norm (..., 1), or 1 where it is less: f(x) = (2 - 1/|x|) x/|x| is the identity at |x| = 1."""
    if order == "linf":
        x, y, z = points.abs().split(1, dim=-1)  # quicker than a reduction over three numbers
        return torch.maximum(torch.maximum(x, y), z).clamp(min=1)
    with torch.no_grad():  # the square of 1e30 is infinite in float32
        scale = _norm(points, "linf")
    return (torch.linalg.vector_norm(points / scale, dim=-1, keepdim=True) * scale).clamp(min=1)


class Contraction(nn.Module):
    """World points (..., 3) -> the unit cube (..., 3); `inverse` goes back.

    `bounded`: whether some points are mapped outside the cube.
    """

    bounded = False

    def forward(self, points: Tensor) -> Tensor:
        raise NotImplementedError

    def inverse(self, unit: Tensor) -> Tensor:
        raise NotImplementedError


class _Norm(Contraction):
    order: str

    def forward(self, points: Tensor) -> Tensor:
        return to_unit(contract(points, self.order))

    def inverse(self, unit: Tensor) -> Tensor:
        return uncontract(4 * unit - 2, self.order)


@CONTRACTIONS.register("linf")
class CubeContraction(_Norm):
    """All of space into the unit cube, by the largest coordinate; [-1, 1]^3 takes its middle half on each axis."""

    order = "linf"


@CONTRACTIONS.register("l2")
class BallContraction(_Norm):
    """All of space into the ball inside the unit cube, by the distance from the origin."""

    order = "l2"


@CONTRACTIONS.register("box")
class Box(Contraction):
    """The box [-h, h]^3 onto the unit cube, for bounded scenes; points outside land outside [0, 1].

    Args:
        half_extent: h, in world units.
    """

    bounded = True

    def __init__(self, *, half_extent: float = 1.0) -> None:
        super().__init__()
        if not 0 < half_extent < float("inf"):
            raise ValueError(f"contraction=box: half_extent must be above 0 and finite, got {half_extent}")
        self.half_extent = half_extent

    def forward(self, points: Tensor) -> Tensor:
        return points / (2 * self.half_extent) + 0.5

    def inverse(self, unit: Tensor) -> Tensor:
        return (unit - 0.5) * (2 * self.half_extent)
