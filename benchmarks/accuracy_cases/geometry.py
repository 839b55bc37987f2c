"""Contraction, pose refinement, lens, view directions.

The derivative of the contraction along the ray through the origin, 1 / |x|^2 in float32, is known to 1 / |x| times some
eps: relative to itself it is lost beyond |x| = 10^6, where the one across is 10^6 times larger. Points at |x| = 1 / eps
and beyond are one point: the inverse gives back 8e6 at most. A rotation of 10^3 rad is off by 6e-5 rad, as its vector
is. Spherical harmonics of directions longer than 10^12 overflow; rays have unit directions. The lens is undone in
float64, and a lens that folds the image is refused when the scene is read.
"""

import math

import torch
from torch import Tensor

from benchmarks.accuracy_cases import EPS, Case, only, rounded
from qnerf.encoders import spherical_harmonics
from qnerf.geometry.contraction import ORDERS, contract, uncontract
from qnerf.geometry.rotations import exp_se3, exp_so3xr3
from qnerf.scenes.lens import ITERATIONS, distort, undistort

CONTRACTED = 4 * EPS
"""Relative to 2, the edge of contracted space: two divisions, a difference, a product and the norm."""
CONTRACTION_GRADIENT = 16 * EPS
"""Relative to the largest derivative at the same point, about 1 / |x|. The radial one, 1 / |x|^2, is the difference of
two of that size: on its own it loses a factor |x|, which is little beside what the others bring into any product."""
UNCONTRACTED = 8 * EPS
"""Times the norm |x| of the result, relative to it: 2 - 1/|x| is known to some eps, so 1/|x| to some eps |x|."""
ROTATION = 8 * EPS
"""Of the entries of a rotation matrix, and of its product with its transpose: sine and cosine parts of two roundings
each, K^2 of three, their sum."""
MOTION = 16 * EPS
"""Relative to the largest entry: a rotation's, and the product of the left Jacobian with the translation."""
ANGLE = 2 * EPS
"""Of the angle itself, relative: what a rotation vector of many turns loses, since its length is rounded."""
HARMONICS = 8 * EPS
"""Relative to the largest: at most five products and sums with a rounded constant each."""
DISTORTED = 12 * EPS
"""Relative to the largest coordinate: a polynomial of degree five."""
UNDISTORTED = 32 * EPS
"""The distorted point's error divided by the least slope of the lenses here, 0.5; rays take it in float64."""


def _contractions() -> list[Case]:
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(4096, 3, generator=generator, dtype=torch.float64)
    near = directions * torch.rand(4096, 1, generator=generator)
    far = directions * 10 ** (30 * torch.rand(4096, 1, generator=generator, dtype=torch.float64))
    one = torch.tensor([1 - EPS / 2, 1.0, 1 + EPS], dtype=torch.float64)
    border = torch.cartesian_prod(one, torch.tensor([0.0, 0.3, -0.9]).double(), torch.tensor([0.0, 0.5]).double())
    inputs = {"around the origin": near, "0": torch.zeros(4, 3), "norm 1 +- 1 ulp": border, "up to 1e30": far}
    return [case for order in ORDERS for case in _order(order, inputs, rounded(contract(_within(near, 10), order)))]


def _within(points: Tensor, norm: float) -> Tensor:
    return norm * points / points.abs().amax() / math.sqrt(3)


def _order(order: str, points: dict[str, Tensor], contracted: Tensor) -> list[Case]:
    def contracted_point(x: Tensor) -> Tensor:
        return contract(x, order)

    def world_point(y: Tensor) -> Tensor:
        return uncontract(y, order)

    cases = [
        Case("contraction", f"{order}, {text}", only(contracted_point), (rounded(x),), CONTRACTED)
        for text, x in points.items()
    ]
    return [*cases, Case("contraction", f"{order}, inverse", only(world_point), (contracted,), 10 * UNCONTRACTED)]


def _poses() -> list[Case]:
    generator = torch.Generator().manual_seed(1)
    axis = torch.nn.functional.normalize(torch.randn(512, 3, generator=generator, dtype=torch.float64), dim=-1)
    shift = torch.randn(512, 3, generator=generator, dtype=torch.float64)
    angles = {"zero": 0.0, "1e-20 rad": 1e-20, "1e-3 rad": 1e-3, "1 rad": 1.0, "pi": math.pi, "2 pi": 2 * math.pi}
    return [
        Case(
            "poses",
            f"{name}, rotation {text}",
            only(function),
            (rounded(torch.cat([shift, axis * angle], -1)),),
            MOTION,
        )
        for name, function in (("so3xr3", exp_so3xr3), ("se3", exp_se3))
        for text, angle in angles.items()
    ]


def _lenses() -> list[Case]:
    generator = torch.Generator().manual_seed(2)
    points = rounded(1.2 * torch.rand(4096, 2, generator=generator) - 0.6)
    lens = rounded(torch.tensor([-0.1, 0.05, 0.01, -0.01]))

    def inverse(points: Tensor, lens: Tensor) -> Tensor:
        return undistort(points, lens)

    return [
        Case("lens", "distort", only(distort), (points, lens), DISTORTED, wanted=(0,)),
        Case("lens", f"undistort, {ITERATIONS} steps", only(inverse), (points, lens), UNDISTORTED, wanted=(0,)),
    ]


def _directions() -> list[Case]:
    generator = torch.Generator().manual_seed(3)
    unit = torch.nn.functional.normalize(torch.randn(4096, 3, generator=generator, dtype=torch.float64), dim=-1)

    def harmonics(directions: Tensor) -> Tensor:
        return spherical_harmonics(directions, 4)

    inputs = {"unit": unit, "of length 1e4": 1e4 * unit, "zero": torch.zeros(4, 3)}
    return [
        Case("spherical harmonics", name, only(harmonics), (rounded(directions),), HARMONICS)
        for name, directions in inputs.items()
    ]


def cases() -> list[Case]:
    return [*_contractions(), *_poses(), *_lenses(), *_directions()]
