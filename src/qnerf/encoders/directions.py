"""View directions -> features."""

from functools import cache
from itertools import product
from typing import Any, Literal

import torch
from torch import Tensor, nn

from qnerf.config import bounds
from qnerf.config.bounds import NonNegativeFactor
from qnerf.config.registry import Registry

DIRECTIONS: Registry["Directions"] = Registry("directions")
Degree = Literal[1, 2, 3, 4]


POLYNOMIALS: list[dict[str, float]] = [
    {"": 0.28209479177387814},
    {"y": 0.4886025119029199},
    {"z": 0.4886025119029199},
    {"x": 0.4886025119029199},
    {"xy": 1.0925484305920792},
    {"yz": 1.0925484305920792},
    {"zz": 0.9461746957575601, "": -0.31539156525252005},
    {"xz": 1.0925484305920792},
    {"xx": 0.5462742152960396, "yy": -0.5462742152960396},
    {"xxy": 3 * 0.5900435899266435, "yyy": -0.5900435899266435},
    {"xyz": 2.890611442640554},
    {"yzz": 5 * 0.4570457994644658, "y": -0.4570457994644658},
    {"zzz": 5 * 0.3731763325901154, "z": -3 * 0.3731763325901154},
    {"xzz": 5 * 0.4570457994644658, "x": -0.4570457994644658},
    {"xxz": 1.445305721320277, "yyz": -1.445305721320277},
    {"xxx": 0.5900435899266435, "xyy": -3 * 0.5900435899266435},
]
"""The harmonics of bands 0 to 3, each m from -l to l: products of coordinates and their factors."""


def spherical_harmonics(directions: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics of bands 0..degree - 1 of unit directions (..., 3): (..., degree^2), degree 1 to 4.

    Orthonormal over the sphere, band by band with m from -l to l, as polynomials in (x, y, z) without the
    Condon-Shortley sign. Directions of other lengths, zero included, give the values of these polynomials. In float32
    they are finite up to a length of 1e12.

    >>> spherical_harmonics(torch.tensor([[0.0, 0.0, 1.0]]), degree=4).shape
    torch.Size([1, 16])
    """
    bounds.check("directions=sh: degree", degree, Degree)
    products = factors = torch.cat([torch.ones_like(directions[..., :1]), directions], -1)
    for _ in range(degree - 2):
        products = (products[..., None] * factors[..., None, :]).flatten(-2)
    first, second, of_first, of_second = _terms(degree, directions.dtype, directions.device)
    return products.index_select(-1, first) * of_first + products.index_select(-1, second) * of_second


@cache
def _terms(degree: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, ...]:
    """Of each harmonic: the places of its two terms among the products of 1, x, y, z, and their factors.

    The factor of a term that there is not is 0.
    """
    length = max(degree - 1, 1)
    products = ["".join(each) for each in product("1xyz", repeat=length)]
    columns: list[tuple[float, ...]] = []
    for polynomial in POLYNOMIALS[: degree**2]:
        terms = [*polynomial.items(), ("", 0.0)][:2]
        columns.append((*(products.index(name.rjust(length, "1")) for name, _ in terms), *(one for _, one in terms)))
    first, second, of_first, of_second = zip(*columns, strict=True)
    factors = [torch.tensor(each, dtype=dtype, device=device) for each in (of_first, of_second)]
    return torch.tensor(first, device=device), torch.tensor(second, device=device), *factors


class Directions(nn.Module):
    """Unit directions (..., 3) -> features (..., out_dim).

    Args:
        interval: "signed" takes the direction d as it is; "unit" takes (d + 1) / 2, whose coordinates lie in [0, 1].
            Nerfacto's heads receive "unit"; tiny-cuda-nn turns it back before its spherical harmonics, nerfstudio's
            PyTorch implementation does not.
    """

    out_dim: int

    def __init__(self, *, interval: Literal["signed", "unit"] = "signed") -> None:
        super().__init__()
        self.interval = interval

    def inputs(self, directions: Tensor) -> Tensor:
        """The directions in the chosen interval."""
        return directions if self.interval == "signed" else (directions + 1) / 2


@DIRECTIONS.register("sh")
class SphericalHarmonics(Directions):
    """`spherical_harmonics` of unit directions (..., 3): (..., degree^2).

    Args:
        degree: number of bands, 1 to 4.
    """

    def __init__(self, in_dim: int = 3, *, degree: Degree = 4, **options: Any) -> None:
        super().__init__(**options)
        if in_dim != 3:
            raise ValueError(f"directions=sh: directions must have 3 coordinates, got {in_dim}")
        self.degree = degree
        self.out_dim = degree**2

    def forward(self, directions: Tensor) -> Tensor:
        return spherical_harmonics(self.inputs(directions), self.degree)


@DIRECTIONS.register("raw")
class RawDirections(Directions):
    """The directions themselves (..., in_dim), times `scale`.

    Args:
        scale: factor.
    """

    def __init__(self, in_dim: int = 3, *, scale: NonNegativeFactor = 1.0, **options: Any) -> None:
        super().__init__(**options)
        self.scale = scale
        self.out_dim = in_dim

    def forward(self, directions: Tensor) -> Tensor:
        inputs = self.inputs(directions)
        return inputs if self.scale == 1.0 else inputs * self.scale
