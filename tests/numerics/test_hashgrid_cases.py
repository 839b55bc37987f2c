"""The hash grid in float32 against float64 where cells meet, at every resolution it allows."""

import torch
from hypothesis import given, target
from hypothesis import strategies as st

from benchmarks.accuracy_cases import EPS, rounded
from benchmarks.accuracy_cases.encoding import FEATURES
from qnerf.kernels.hashgrid import FINEST, hash_encode
from tests.helpers.hard_inputs import seeds

POINT_GRADIENTS = 32 * EPS
"""Relative to resolution times the largest upstream, with entries below 1: four differences of corners, whose sums may
cancel, with three products and a rounded place each."""
TABLE_GRADIENTS = 16 * EPS
"""Relative to the largest upstream, for one point: its weights, as in FEATURES."""

RESOLUTIONS = st.sampled_from([1, 2, 16, 1023, 1024, 2048, 2**17, FINEST]) | st.integers(1, FINEST)


@st.composite
def coordinates(draw):
    """A resolution, and a point with coordinates on borders, some ulp beside them, at 0 and 1, outside, anywhere."""
    cells = draw(RESOLUTIONS)
    borders = st.integers(0, cells).map(lambda k: k / cells)
    beside = st.tuples(borders, st.integers(-3, 3)).map(lambda pair: pair[0] * (1 + pair[1] * EPS))
    one = borders | beside | st.sampled_from([0.0, 1.0, -0.5, 1.5, 1e30]) | st.floats(0, 1, width=32)
    return cells, draw(st.lists(one, min_size=3, max_size=3))


def encoded(dtype, point, table, cells, upstream):
    leaves = point.to(dtype).requires_grad_(), table.to(dtype).requires_grad_()
    out = hash_encode(*leaves, cells)
    return [t.detach().double() for t in (out, *torch.autograd.grad(out, leaves, upstream.to(dtype)))]


@given(where=coordinates(), seed=seeds, features=st.sampled_from([1, 2, 3]))
def test_float32_features_and_gradients_at_cell_borders(where, seed, features):
    """The cell is that of float64, so that the gradient, which jumps at a border, is too."""
    generator = torch.Generator().manual_seed(seed)
    table = rounded(2 * torch.rand(1, 64, features, generator=generator) - 1)
    upstream = rounded(2 * torch.rand(1, features, generator=generator) - 1)
    arguments = rounded([where[1]]), table, torch.tensor([where[0]]), upstream
    exact = encoded(torch.float64, *arguments)
    found = encoded(torch.float32, *arguments)
    largest = float(upstream.abs().max())
    scales = (FEATURES, POINT_GRADIENTS * where[0] * features * largest, TABLE_GRADIENTS * largest)
    errors = [float((a - b).abs().max()) / scale for a, b, scale in zip(found, exact, scales, strict=True) if scale]
    target(max(errors))
    assert max(errors) <= 1
