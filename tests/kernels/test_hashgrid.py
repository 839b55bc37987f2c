"""The hash grid's compiled path against its plain PyTorch reference, and both at the edges: kernels/hashgrid.py."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qnerf.encoders import level_resolutions
from qnerf.kernels.hashgrid import hash_encode, hash_encode_reference

BOTH = pytest.mark.parametrize("encode", [hash_encode, hash_encode_reference])
NAN = float("nan")


def case(points, resolutions, log2_size, features, dtype=torch.float32, seed=0):
    """Random points (some on borders, some outside), table and level resolutions."""
    generator = torch.Generator().manual_seed(seed)
    cells = torch.tensor(resolutions)
    x = torch.rand(points, 3, generator=generator, dtype=torch.float64) * 1.2 - 0.1
    if points:
        x[::3] = (x[::3] * cells[0]).round() / cells[0]
    table = torch.rand(len(resolutions), 2**log2_size, features, generator=generator, dtype=torch.float64) * 2 - 1
    return x.to(dtype), table.to(dtype), cells


def gradients(encode, points, table, cells, dense=True):
    points, table = points.clone().requires_grad_(), table.clone().requires_grad_()
    out = encode(points, table, cells, dense)
    weight = torch.linspace(-1, 1, out.numel(), dtype=out.dtype).view_as(out)
    return torch.autograd.grad(out, (points, table), weight)


CASES = {
    "points": st.integers(0, 300),
    "resolutions": st.lists(st.integers(1, 200), min_size=1, max_size=5),
    "log2_size": st.integers(1, 9),
    "features": st.sampled_from([1, 2, 3, 4, 8]),
    "dense": st.booleans(),
    "seed": st.integers(0, 2**31),
}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@settings(max_examples=30)
@given(**CASES)
def test_features_are_those_of_the_reference(dtype, points, resolutions, log2_size, features, dense, seed):
    arguments = (*case(points, resolutions, log2_size, features, dtype, seed), dense)
    fast = hash_encode(*arguments)
    assert fast.dtype == dtype
    assert fast.shape == (points, len(resolutions) * features)
    torch.testing.assert_close(fast, hash_encode_reference(*arguments), rtol=0, atol=8 * torch.finfo(dtype).eps)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@settings(max_examples=30)
@given(**CASES)
def test_gradients_are_those_of_the_reference(dtype, points, resolutions, log2_size, features, dense, seed):
    """Both add the same terms in another order: they differ by at most 4 eps times the sum of the largest terms."""
    x, table, cells = case(points, resolutions, log2_size, features, dtype, seed)
    fast, plain = (gradients(encode, x, table, cells, dense) for encode in (hash_encode, hash_encode_reference))
    terms = (8 * features * sum(resolutions), 8 * max(points, 1))
    for a, b, largest in zip(fast, plain, terms, strict=True):
        assert a.dtype == dtype
        torch.testing.assert_close(a, b, rtol=0, atol=4 * torch.finfo(dtype).eps * largest)


@BOTH
@pytest.mark.parametrize("features", [1, 2, 4])
def test_a_full_grid_interpolates_its_vertices_exactly(encode, features):
    """A trilinear function lies in the span of the grid: it is reproduced everywhere."""
    n = 4
    i = torch.arange(8**3)
    side = n + 1
    vertex = torch.stack((i % side, i // side % side, i // side**2), dim=-1).double() / n
    function = lambda p: 1 + p[:, 0] - 2 * p[:, 1] * p[:, 2] + 3 * p.prod(-1)  # noqa: E731
    table = torch.stack([function(vertex) * (f + 1) for f in range(features)], dim=-1)[None]
    x, _, cells = case(200, [n], 9, 1, torch.float64)
    expected = torch.stack([function(x.clamp(0, 1)) * (f + 1) for f in range(features)], dim=-1)
    torch.testing.assert_close(encode(x, table, cells), expected, rtol=0, atol=1e-13)


@BOTH
def test_hashed_rows_are_those_of_the_published_function(encode):
    n, size = 50, 64
    table = torch.arange(size, dtype=torch.float64).view(1, size, 1)
    vertices = torch.randint(0, n + 1, (300, 3), generator=torch.Generator().manual_seed(0))
    rows = [(x ^ y * 2654435761 ^ z * 805459861) % 2**32 % size for x, y, z in vertices.tolist()]
    encoded = encode(vertices.double() / n, table, torch.tensor([n]))[:, 0]
    torch.testing.assert_close(encoded, torch.tensor(rows, dtype=torch.float64), rtol=0, atol=1e-9)


@BOTH
def test_levels_that_fit_are_indexed_without_collisions(encode):
    fits, hashed = (torch.tensor([n]) for n in (3, 4))  # 4^3 = 64 vertices fit into 64 entries, 5^3 do not
    x, table, _ = case(100, [3], 6, 1)
    assert not torch.equal(encode(x, table, fits, True), encode(x, table, fits, False))
    assert torch.equal(encode(x, table, hashed, True), encode(x, table, hashed, False))


@BOTH
def test_points_outside_are_moved_to_the_nearest_face(encode):
    _, table, cells = case(0, [3, 70], 7, 2)
    outside = torch.tensor(
        [[-0.3, 0.5, 0.2], [1e30, 0.1, -1e30], [float("inf"), -float("inf"), 0.4], [-1e-45, 2.0, 1.0]]
    )
    assert torch.equal(encode(outside, table, cells), encode(outside.clamp(0, 1), table, cells))
    to_points, _ = gradients(encode, outside, table, cells)
    assert torch.equal(to_points == 0, (outside < 0) | (outside > 1))


@BOTH
@pytest.mark.parametrize("features", [1, 2, 3])
def test_nan_gives_nan_and_touches_no_other_point(encode, features):
    x, table, cells = case(260, [3, 70], 7, features)
    bad = x.clone()
    bad[5, 0] = bad[130, 1] = bad[259, 2] = NAN
    bad[200] = NAN
    encoded = encode(bad, table, cells)
    rows = bad.isnan().any(-1)
    assert encoded[rows].isnan().all()
    assert torch.equal(encoded[~rows], encode(x, table, cells)[~rows])
    to_points, _ = gradients(encode, bad, table, cells)
    assert not to_points[~rows].isnan().any()
    assert not to_points[bad.isnan()].any()


def test_gradients_are_computed_where_they_are_needed():
    x, table, cells = case(50, [4, 9], 8, 2)
    both = gradients(hash_encode, x, table, cells)
    points = x.clone().requires_grad_()
    out = hash_encode(points, table, cells)
    weight = torch.linspace(-1, 1, out.numel()).view_as(out)
    out.backward(weight)
    assert torch.equal(points.grad, both[0])
    assert table.grad is None
    parameter = torch.nn.Parameter(table.clone())
    hash_encode(x, parameter, cells).backward(weight)
    assert torch.equal(parameter.grad, both[1])


def test_strided_and_expanded_tensors():
    x, table, cells = case(40, [4, 9], 8, 2)
    expected = hash_encode(x, table, cells)
    assert torch.equal(hash_encode(x.t().contiguous().t(), table, cells), expected)
    leaf = table.transpose(1, 2).contiguous().requires_grad_()
    out = hash_encode(x, leaf.transpose(1, 2), cells)
    assert torch.equal(out, expected)
    out.sum().backward()  # its gradient is an expanded scalar
    whole = table.clone().requires_grad_()
    hash_encode(x, whole, cells).sum().backward()
    assert torch.equal(leaf.grad.transpose(1, 2), whole.grad)


WRONG = [
    (r"points must be \(N, 3\)", {"points": torch.zeros(4, 2)}),
    ("power of two", {"table": torch.zeros(2, 6, 1)}),
    ("power of two", {"table": torch.zeros(2, 1, 1)}),
    ("table must be", {"table": torch.zeros(2, 8, 0)}),
    ("share a dtype", {"table": torch.zeros(2, 8, 1, dtype=torch.float64)}),
    ("resolutions must be int64", {"resolutions": torch.tensor([1, 2, 3])}),
    ("resolutions must be int64", {"resolutions": torch.tensor([1.0, 2.0])}),
    ("must be 1 to", {"resolutions": torch.tensor([0, 4])}),
    ("must be 1 to", {"resolutions": torch.tensor([4, 2**21])}),
]


def test_hash_grid_refuses_tensors_that_do_not_fit():
    right = {"points": torch.zeros(4, 3), "table": torch.zeros(2, 8, 1), "resolutions": torch.tensor([1, 2])}
    for message, change in WRONG:
        with pytest.raises(ValueError, match=message) as error:
            hash_encode(**{**right, **change})
        assert "\n" not in str(error.value)


@given(levels=st.integers(1, 32), low=st.integers(1, 4096), ratio=st.floats(1, 256))
def test_level_resolutions_have_exact_ends_and_do_not_fall(levels, low, ratio):
    high = int(low * ratio)
    resolutions = level_resolutions(levels, low, high)
    assert len(resolutions) == levels
    assert resolutions[0] == low
    assert resolutions[-1] == (high if levels > 1 else low)
    assert resolutions == sorted(resolutions)
