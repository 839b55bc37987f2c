"""World space into the unit cube: contraction.py."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.autograd import gradcheck

from qnerf.geometry.contraction import CONTRACTIONS, ORDERS, contract, uncontract

EACH_ORDER = pytest.mark.parametrize("order", ORDERS)
EACH_DTYPE = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
COORDINATE = st.floats(-1e30, 1e30) | st.floats(-3, 3)
POINT = st.tuples(COORDINATE, COORDINATE, COORDINATE)


def norm(points, order):
    return torch.linalg.vector_norm(points.double(), ord={"linf": math.inf, "l2": 2}[order], dim=-1)


def formula(point, order):
    """f(x) = x if |x| <= 1 else (2 - 1/|x|) x/|x|, in Python floats."""
    size = max(map(abs, point)) if order == "linf" else math.hypot(*point)
    factor = 1 if size <= 1 else (2 - 1 / size) / size
    return [factor * x for x in point]


@EACH_ORDER
@EACH_DTYPE
@settings(max_examples=200)
@given(point=POINT)
def test_contract_is_its_formula_in_the_cube_with_a_finite_gradient(order, dtype, point):
    x = torch.tensor([point], dtype=dtype, requires_grad=True)
    contracted = contract(x, order)
    expected = torch.tensor([formula(x[0].tolist(), order)], dtype=torch.float64)
    torch.testing.assert_close(contracted.double(), expected, rtol=0, atol=8 * torch.finfo(dtype).eps)
    unit = (contracted + 2) / 4
    assert unit.dtype == dtype
    assert ((unit >= 0) & (unit <= 1)).all()
    for axis in range(3):
        (gradient,) = torch.autograd.grad(unit[0, axis], x, retain_graph=True)
        assert gradient.isfinite().all()
        assert gradient.abs().max() <= 0.5


@EACH_ORDER
@EACH_DTYPE
@settings(max_examples=200)
@given(point=st.tuples(*[st.floats(-1e3, 1e3)] * 3))
def test_uncontract_is_the_inverse(order, dtype, point):
    x = torch.tensor([point], dtype=dtype)
    back = uncontract(contract(x, order), order)
    largest = max(1.0, norm(x, order).item())
    # 2 - |f| = 1/|x| is known to some eps, so |x| to some eps |x| relative
    torch.testing.assert_close(back, x, rtol=0, atol=8 * torch.finfo(dtype).eps * largest**2)


@EACH_ORDER
def test_contract_and_its_inverse_have_the_derivatives_of_finite_differences(order):
    x = torch.tensor([[0.3, -0.2, 0.1], [3.0, 1.0, -2.0], [-0.5, 40.0, 7.0], [1.5, 0.2, 0.9]], dtype=torch.float64)
    assert gradcheck(lambda p: contract(p, order), x.requires_grad_())
    inside = (0.8 * contract(x.detach(), order)).requires_grad_()
    assert gradcheck(lambda p: uncontract(p, order), inside)


@EACH_ORDER
@EACH_DTYPE
def test_contract_takes_points_far_away_and_infinite_ones(order, dtype):
    inf = float("inf")
    x = torch.tensor(
        [[1e30, 0, 0], [-1e30, 1e30, 0], [0, inf, 1.0], [-inf, inf, 5.0], [3e38, -3e38, 3e38]],
        dtype=dtype,
        requires_grad=True,
    )
    y = contract(x, order)
    diagonal = 2 if order == "linf" else math.sqrt(2)
    cubic = 2 if order == "linf" else 2 / math.sqrt(3)
    expected = torch.tensor(
        [[2, 0, 0], [-diagonal, diagonal, 0], [0, 2, 0], [-diagonal, diagonal, 0], [cubic, -cubic, cubic]], dtype=dtype
    )
    torch.testing.assert_close(y, expected, rtol=0, atol=8 * torch.finfo(dtype).eps)
    (gradient,) = torch.autograd.grad(y.sum(), x)
    assert gradient.isfinite().all()
    assert not gradient[x.isinf()].any()


@EACH_ORDER
def test_nan_makes_its_own_point_nan_only(order):
    x = torch.tensor([[0.1, float("nan"), 3.0], [0.1, 0.2, 3.0]])
    y = contract(x, order)
    assert y[0].isnan().all()
    assert y[1].isfinite().all()


@EACH_ORDER
def test_the_edge_of_space_is_far_but_finite(order):
    back = uncontract(torch.tensor([[2.0, 0, 0], [2.5, 2.5, 0], [0, -2.0, 2.0]]), order)
    assert back.isfinite().all()
    assert (norm(back, order) > 8e6).all()


@pytest.mark.parametrize("name", ["box", "l2", "linf"])
def test_contractions_go_there_and_back(name):
    contraction = CONTRACTIONS.build(name)
    x = torch.rand(4, 5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 6 - 3
    unit = contraction(x)
    assert unit.shape == x.shape
    torch.testing.assert_close(contraction.inverse(unit), x, rtol=0, atol=1e-12)
    if name != "box":
        assert torch.equal(unit, (contract(x, name) + 2) / 4)
    torch.testing.assert_close(contraction(torch.zeros(1, 3)), torch.full((1, 3), 0.5))
    assert contraction.bounded == (name == "box")
    assert CONTRACTIONS.names() == ["box", "l2", "linf"]


def test_a_box_maps_its_half_extent_to_the_unit_cube():
    box = CONTRACTIONS.build("box", half_extent=2.0)
    x = torch.tensor([[-2.0, 0, 2], [-3, 1, 6]])
    assert box(x).tolist() == [[0, 0.5, 1], [-0.25, 0.75, 2]]
