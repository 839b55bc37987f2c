"""A hash grid with an MLP in one loop against its plain PyTorch reference: kernels/grid_mlp.py."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qnerf.kernels.grid_mlp import Grid, grid_mlp, grid_mlp_reference
from tests.kernels.test_mlp import random_layers

CASES = {
    "count": st.integers(0, 1500),
    "share": st.sampled_from([0.0, 0.1, 0.9, 1.0, None]),
    "levels": st.integers(1, 6),
    "features": st.sampled_from([1, 2, 3]),
    "widths": st.lists(st.integers(1, 19), min_size=1, max_size=3),
    "dense": st.booleans(),
    "seed": st.integers(0, 2**31),
}


def case(count, share, levels, features, widths, dense, seed, dtype):
    """Random points, which of them are inside, and parameters with gradients."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64).to(dtype).requires_grad_()

    points = torch.rand(count, 3, generator=generator, dtype=torch.float64).to(dtype)
    inside = None if share is None else torch.rand(count, generator=generator) < share
    grid = Grid(normal(levels, 2**7, features), torch.arange(2, 2 + 3 * levels, 3), dense)
    return points, inside, grid, random_layers([levels * features, *widths], dtype, generator)


def parameters(grid, layers):
    return [grid.table, *(tensor for layer in layers for tensor in layer)]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@settings(max_examples=40)
@given(**CASES)
def test_hash_grid_with_mlp_has_the_values_and_gradients_of_the_reference(dtype, **options):
    points, inside, *layers = case(**options, dtype=dtype)
    fast, slow = grid_mlp(points, inside, *layers), grid_mlp_reference(points, inside, *layers)
    eps = torch.finfo(dtype).eps
    assert fast.dtype == dtype
    torch.testing.assert_close(fast, slow, rtol=0, atol=200 * eps)
    evaluated = torch.ones(len(points), dtype=torch.bool) if inside is None else inside
    assert bool((fast[~evaluated, 0] == -torch.inf).all())
    upstream = torch.where(
        evaluated[:, None], torch.linspace(-1, 1, fast.numel(), dtype=dtype).view_as(fast), torch.nan
    )
    # The reference would multiply the NaN of points that are not inside by 0; the loop never reads it.
    found = torch.autograd.grad(fast, parameters(*layers), upstream)
    expected = torch.autograd.grad(slow, parameters(*layers), upstream.nan_to_num())
    for ours, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=200 * eps * max(len(points), 1))


def test_a_point_that_is_not_a_number_has_values_that_are_none():
    points, _, *layers = case(200, None, 2, 1, [4, 2], True, 1, torch.float32)
    points[3] = torch.nan
    values = grid_mlp(points, None, *layers)
    assert values[3].isnan().all()
    assert values[[*range(3), *range(4, 200)]].isfinite().all()


WRONG = [
    ("points without gradient expected", lambda p, i, g, layers: (p.clone().requires_grad_(), i, g, layers)),
    ("points must be", lambda p, i, g, layers: (p[:, :2], i, g, layers)),
    ("inside must be bool", lambda p, i, g, layers: (p, i[:10], g, layers)),
    ("inside must be bool", lambda p, i, g, layers: (p, i.int(), g, layers)),
    ("on 4 features expected", lambda p, i, g, layers: (p, i, g, layers[1:])),
]


def test_hash_grid_with_mlp_refuses_wrong_arguments():
    arguments = case(300, 0.5, 2, 2, [8, 3], True, 0, torch.float32)
    for message, change in WRONG:
        with pytest.raises(ValueError, match=message):
            grid_mlp(*change(*arguments))
