"""A multilayer perceptron in compiled loops against its plain PyTorch reference: kernels/mlp.py."""

from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qnerf.heads import MLPHead
from qnerf.kernels.dispatch import report
from qnerf.kernels.mlp import Layer, layers_of, mlp, mlp_reference

WIDTHS = st.lists(st.integers(1, 70), min_size=2, max_size=5)


def random_layers(widths, dtype, generator):
    """Weights and biases, with gradients, of linear layers between features of these widths."""

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64).to(dtype).requires_grad_()

    return [Layer(normal(units, inputs), normal(units)) for inputs, units in pairwise(widths)]


def case(count, widths, dtype, seed):
    generator = torch.Generator().manual_seed(seed)
    rows = torch.randn(count, widths[0], generator=generator, dtype=torch.float64).to(dtype).requires_grad_()
    layers = random_layers(widths, dtype, generator)
    return rows, layers, [rows, *(tensor for layer in layers for tensor in layer)]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@settings(max_examples=40)
@given(count=st.integers(0, 2500), widths=WIDTHS, seed=st.integers(0, 2**31), first=st.sampled_from([0, 1]))
def test_mlp_has_the_values_and_gradients_of_the_reference(dtype, count, widths, seed, first):
    rows, layers, leaves = case(count, widths, dtype, seed)
    # Of -1, 0 and 1 all values are exact, so that the same units are positive.
    with torch.no_grad():
        for leaf in leaves:
            leaf.copy_(leaf.round().clamp(-1, 1))
    fast, slow = mlp(rows, layers), mlp_reference(rows, layers)
    assert fast.dtype == dtype
    assert torch.equal(fast, slow)
    upstream = (torch.arange(fast.numel(), dtype=dtype) % 3 - 1).view_as(fast)
    found, expected = (torch.autograd.grad(values, leaves[first:], upstream) for values in (fast, slow))
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.shape == theirs.shape
        bound = 4 * torch.finfo(dtype).eps * max(count, 70) * float(theirs.abs().max()) if count else 0
        torch.testing.assert_close(ours, theirs, rtol=0, atol=bound)


def test_second_derivatives_are_those_of_finite_differences():
    _, _, leaves = case(4, [3, 5, 4, 2], torch.float64, 1)
    assert torch.autograd.gradgradcheck(lambda rows, *parameters: mlp(rows, layers_of(parameters)), leaves)


def test_a_row_that_is_not_a_number_has_values_that_are_none():
    rows, layers, _ = case(200, [3, 20, 2], torch.float32, 2)
    with torch.no_grad():
        rows[3] = torch.nan
        values = mlp(rows, layers)
    assert values[3].isnan().all()
    assert values[[*range(3), *range(4, 200)]].isfinite().all()


def test_mlp_refuses_wrong_shapes():
    rows, layers, _ = case(5, [3, 4, 2], torch.float32, 3)
    for wrong in ((rows[:, :2], layers), (rows, layers[1:]), (rows, []), (rows, [layers[0]._replace(bias=rows[0])])):
        with pytest.raises(ValueError, match="features expected, got the shapes"):
            mlp(*wrong)
    with pytest.raises(ValueError, match=r"rows \(N, D\) expected"):
        mlp(rows[None], layers)


def test_a_head_takes_no_loop_where_its_dtype_or_a_transformation_has_none():
    """What else makes a loop step aside is in `test_dispatch`."""
    rows, head = torch.randn(5, 3), MLPHead(3, 2, layers=3, width=8)
    with report() as told, torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(head(rows), head.net(rows))
    assert told == {"MLP": "autocast"}
    with report() as told:
        head.to(torch.bfloat16)(rows.bfloat16())
    assert told == {"MLP": "bfloat16"}
    frozen = MLPHead(3, 2).requires_grad_(False)
    torch.testing.assert_close(torch.func.vmap(frozen)(rows[None])[0], frozen(rows))
