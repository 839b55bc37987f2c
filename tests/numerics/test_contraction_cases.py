"""The contraction's derivative from 0 over norm 1 to 1e30."""

import pytest
import torch
from hypothesis import given, target
from hypothesis import strategies as st

from benchmarks.accuracy_cases import EPS, rounded
from benchmarks.accuracy_cases.geometry import CONTRACTION_GRADIENT
from qnerf.geometry.contraction import ORDERS, contract

EACH_ORDER = pytest.mark.parametrize("order", ORDERS)
ULPS = st.integers(-4, 4).map(lambda steps: 1 + steps * EPS / 2)
SIZES = ULPS | st.floats(0, 30).map(lambda power: 10.0**power) | st.floats(0, 2)
AXES = st.tuples(*[st.floats(-1, 1, width=32)] * 3).filter(lambda axis: max(map(abs, axis)) > 1e-3)


def scaled(axis, size):
    """The point of that largest coordinate, as float32 holds it."""
    return rounded([size * x / max(map(abs, axis)) for x in axis])


@EACH_ORDER
@given(axis=AXES, size=SIZES)
def test_the_derivative_of_contract_in_float32(order, axis, size):
    point = scaled(axis, size)
    jacobians = [
        torch.autograd.functional.jacobian(lambda x: contract(x, order), point.to(dtype)).double()
        for dtype in (torch.float64, torch.float32)
    ]
    if order == "linf" and float(point.abs().topk(2).values.diff().abs()) == 0:
        return  # on a diagonal of the cube the derivative is one-sided
    error = float((jacobians[1] - jacobians[0]).abs().max() / jacobians[0].abs().max())
    target(error)
    assert error <= CONTRACTION_GRADIENT
