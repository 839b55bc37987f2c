"""View directions -> features."""

from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn

from qnerf.config import bounds
from qnerf.config.bounds import NonNegativeFactor
from qnerf.config.registry import Registry
from qnerf.config.tensors import returned

DIRECTIONS: Registry["Directions"] = Registry("directions")
Degree = Literal[1, 2, 3, 4]
DEGREES = get_args(Degree)


def spherical_harmonics(directions: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics of bands 0..degree - 1 of unit directions (..., 3): (..., degree^2), degree 1 to 4.

    Orthonormal over the sphere, band by band with m from -l to l, as polynomials in (x, y, z) without the
    Condon-Shortley sign. Directions of other lengths, zero included, give the values of these polynomials. In float32
    they are finite up to a length of 1e12.

    >>> spherical_harmonics(torch.tensor([[0.0, 0.0, 1.0]]), degree=4).shape
    torch.Size([1, 16])
    """
    if degree not in DEGREES:
        bounds.check("directions=sh: degree", degree, Degree)
    x, y, z = directions.unbind(-1)
    terms = [torch.full_like(x, 0.28209479177387814)]
    if degree > 1:
        terms += [0.4886025119029199 * y, 0.4886025119029199 * z, 0.4886025119029199 * x]
    if degree > 2:
        xx, yy, zz = x * x, y * y, z * z
        terms += [
            1.0925484305920792 * x * y,
            1.0925484305920792 * y * z,
            0.9461746957575601 * zz - 0.31539156525252005,
            1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if degree > 3:
        terms += [
            0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            0.4570457994644658 * y * (5 * zz - 1),
            0.3731763325901154 * z * (5 * zz - 3),
            0.4570457994644658 * x * (5 * zz - 1),
            1.445305721320277 * z * (xx - yy),
            0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return torch.stack(terms, dim=-1)


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

    def __call__(self, directions: Tensor) -> Tensor:
        return returned(self, super().__call__(directions), (*directions.shape[:-1], self.out_dim), directions)

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
