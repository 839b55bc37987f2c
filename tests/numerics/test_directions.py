"""Spherical harmonics of directions that are no unit vectors."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, target
from hypothesis import strategies as st

from benchmarks.accuracy_cases import rounded
from benchmarks.accuracy_cases.geometry import HARMONICS
from qnerf.encoders import spherical_harmonics

AXES = st.tuples(*[st.floats(-1, 1, width=32)] * 3)


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
@given(axis=AXES, power=st.floats(-38, 12))
def test_harmonics_of_unnormalised_directions(degree, axis, power):
    """Any length from 0 to 10^12: finite, each band right relative to what it is made of, |d|^l and the constants."""
    direction = rounded([x * 10.0**power for x in axis])
    exact, found = (spherical_harmonics(direction.to(dtype), degree) for dtype in (torch.float64, torch.float32))
    length = max(1.0, float(direction.abs().max()))
    scale = torch.cat([torch.full((2 * band + 1,), 4 * length**band) for band in range(degree)]).double()
    error = float(((found.double() - exact).abs() / scale).max())
    target(error)
    assert error <= HARMONICS


def test_harmonics_of_the_zero_direction_have_a_finite_gradient():
    direction = torch.zeros(3, requires_grad=True)
    values = spherical_harmonics(direction, 4)
    (gradient,) = torch.autograd.grad(values.sum(), direction)
    assert values.detach().nonzero().flatten().tolist() == [0, 6]
    assert bool(gradient.isfinite().all())


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_harmonics_are_orthonormal_over_the_sphere(degree):
    """By a quadrature that is exact for polynomials of the degree of their products."""
    nodes, weights = (torch.from_numpy(one) for one in np.polynomial.legendre.leggauss(8))
    z, angle = nodes[:, None].expand(8, 16), torch.arange(16).double() * math.tau / 16
    across = (1 - z.square()).sqrt()
    values = spherical_harmonics(torch.stack([across * angle.cos(), across * angle.sin(), z], -1), degree)
    products = torch.einsum("i,ijk,ijl->kl", weights * math.tau / 16, values, values)
    torch.testing.assert_close(products, torch.eye(degree**2, dtype=torch.float64))
