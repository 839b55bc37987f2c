from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qnerf.training.losses import (
    distortion,
    interlevel,
    mse,
    outer_measure,
)
from qnerf.types import Samples

DTYPES = [torch.float32, torch.float64]


def histogram(rays: int, bins: int, seed: int, dtype: torch.dtype = torch.float64) -> tuple[Samples, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    s = torch.rand(rays, bins + 1, dtype=dtype, generator=generator).sort(-1).values
    w = torch.rand(rays, bins, dtype=dtype, generator=generator)
    return Samples(1 + 9 * s, s), w / w.sum(-1, keepdim=True)


def slow_distortion(s: torch.Tensor, w: torch.Tensor) -> torch.Tensor:
    mids = (s[:, 1:] + s[:, :-1]) / 2
    pairs = w[:, :, None] * w[:, None, :] * (mids[:, :, None] - mids[:, None, :]).abs()
    return (pairs.sum((1, 2)) + (w.square() * s.diff()).sum(-1) / 3).mean()


def slow_outer(t: torch.Tensor, t_outer: torch.Tensor, w_outer: torch.Tensor) -> torch.Tensor:
    """Per interval: from the last outer edge at or below its start to the first outer edge above its end."""
    out = torch.zeros(t.shape[0], t.shape[1] - 1, dtype=w_outer.dtype)
    for ray in range(t.shape[0]):
        for i in range(t.shape[1] - 1):
            low = max([j for j in range(t_outer.shape[1]) if t_outer[ray, j] <= t[ray, i]], default=0)
            high = min(
                [j for j in range(t_outer.shape[1]) if t_outer[ray, j] > t[ray, i + 1]], default=t_outer.shape[1] - 1
            )
            out[ray, i] = w_outer[ray, low:high].sum()
    return out


def test_mse() -> None:
    color = torch.tensor([[0.0, 0.5, 1.0]])
    assert float(mse(color, torch.zeros(1, 3))) == pytest.approx(1.25 / 3)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("bins", [1, 2, 3, 48, 257])
def test_distortion_is_the_double_sum(bins: int, dtype: torch.dtype) -> None:
    samples, weights = histogram(4, bins, 0, dtype)
    weights.requires_grad_()
    found = distortion(samples, weights)
    exact_weights = weights.detach().double().requires_grad_()
    exact = slow_distortion(samples.spacing.double(), exact_weights)
    rtol = 1e-5 if dtype == torch.float32 else 1e-12
    torch.testing.assert_close(found.double(), exact, rtol=rtol, atol=0)
    (gradient,) = torch.autograd.grad(found * 3, weights)
    (expected,) = torch.autograd.grad(exact * 3, exact_weights)
    assert gradient.dtype == dtype
    torch.testing.assert_close(gradient.double(), expected, rtol=rtol, atol=0)


def test_distortion_of_one_spike_in_float32() -> None:
    """All weight in neighbouring intervals 1e-4 long: a sum of differences would lose its digits."""
    s = torch.cat([torch.zeros(1), torch.linspace(0.7, 0.7005, 6), torch.ones(1)])[None]
    w = torch.tensor([[0.0, 0.2, 0.2, 0.2, 0.2, 0.2, 0.0]])
    exact = slow_distortion(s.double(), w.double())
    torch.testing.assert_close(distortion(Samples(s, s), w).double(), exact, rtol=1e-5, atol=0)


def test_distortion_of_an_empty_ray_is_zero_with_zero_gradient() -> None:
    samples, _ = histogram(1, 5, 0)
    w = torch.zeros(1, 5, dtype=torch.float64, requires_grad=True)
    loss = distortion(samples, w)
    loss.backward()
    assert float(loss.detach()) == 0
    assert w.grad is not None
    assert bool((w.grad == 0).all())


@settings(deadline=None)
@given(
    inner=st.lists(st.integers(0, 8), min_size=2, max_size=7),
    outer=st.lists(st.integers(0, 8), min_size=2, max_size=9),
    seed=st.integers(0, 1000),
)
def test_outer_measure_with_shared_and_duplicated_edges(inner: list[int], outer: list[int], seed: int) -> None:
    t = torch.tensor([sorted(inner)], dtype=torch.float64) / 8
    t_outer = torch.tensor([sorted(outer)], dtype=torch.float64) / 8
    generator = torch.Generator().manual_seed(seed)
    w = torch.rand(1, len(outer) - 1, dtype=torch.float64, generator=generator)
    torch.testing.assert_close(outer_measure(t, t_outer, w), slow_outer(t, t_outer, w))


@pytest.mark.parametrize("dtype", DTYPES)
def test_interlevel_against_the_definition(dtype: torch.dtype) -> None:
    samples, weights = histogram(5, 8, 1, dtype)
    proposals = [histogram(5, 12, 2, dtype), histogram(5, 6, 3, dtype)]
    for _, w in proposals:
        w.requires_grad_()
    weights.requires_grad_()
    found = interlevel(samples, weights, proposals)
    exact_proposals = [(p.spacing.double(), w.detach().double().requires_grad_()) for p, w in proposals]
    expected = torch.zeros((), dtype=torch.float64)
    w = weights.detach().double()
    for t, v in exact_proposals:
        bound = slow_outer(samples.spacing.double(), t, v)
        expected = expected + ((w - bound).clamp(min=0).square() / (w + 1e-7)).mean()
    rtol = 1e-5 if dtype == torch.float32 else 1e-10
    torch.testing.assert_close(found.double(), expected, rtol=rtol, atol=1e-12)
    gradients = torch.autograd.grad(found * 2, [w for _, w in proposals], retain_graph=True)
    exact = torch.autograd.grad(expected * 2, [w for _, w in exact_proposals])
    for a, b in zip(gradients, exact, strict=True):
        assert float(b.abs().sum()) > 0
        torch.testing.assert_close(a.double(), b, rtol=10 * rtol, atol=1e-6 if dtype == torch.float32 else 1e-10)
    assert torch.autograd.grad(found, weights, allow_unused=True) == (None,)


@settings(deadline=None)
@given(seed=st.integers(0, 10_000), merge=st.integers(1, 5))
def test_interlevel_is_zero_where_the_proposal_bounds_the_weights(seed: int, merge: int) -> None:
    """A proposal that is the same histogram on coarser intervals bounds it exactly."""
    samples, weights = histogram(2, 12, seed)
    kept = list(range(0, 13, merge))
    if kept[-1] != 12:
        kept.append(12)
    coarse = samples.spacing[:, kept]
    proposed = torch.stack([weights[:, a:b].sum(-1) for a, b in pairwise(kept)], dim=-1)
    assert float(interlevel(samples, weights, [(Samples(coarse, coarse), proposed)])) < 1e-25


def test_interlevel_of_zero_weights() -> None:
    samples, _ = histogram(2, 6, 0)
    proposal, _ = histogram(2, 4, 1)
    zero = torch.zeros(2, 4, dtype=torch.float64, requires_grad=True)
    loss = interlevel(samples, torch.zeros(2, 6, dtype=torch.float64), [(proposal, zero)])
    loss.backward()
    assert float(loss.detach()) == 0
    assert zero.grad is not None
    assert bool(torch.isfinite(zero.grad).all())


def test_interlevel_of_a_proposal_without_gradient_and_of_none() -> None:
    samples, weights = histogram(2, 6, 0)
    loss = interlevel(samples, weights, [histogram(2, 4, 1)])
    assert not loss.requires_grad
    assert float(loss.detach()) > 0
    assert float(interlevel(samples, weights, [])) == 0


def test_losses_do_not_depend_on_the_number_of_threads() -> None:
    samples, weights = histogram(3000, 48, 0, torch.float32)
    outer, proposed = histogram(3000, 96, 1, torch.float32)
    results = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        w, v = weights.clone().requires_grad_(), proposed.clone().requires_grad_()
        losses = distortion(samples, w), interlevel(samples, w, [(outer, v)])
        results.append([*losses, *torch.autograd.grad(losses[0], w), *torch.autograd.grad(losses[1], v)])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_nan_weights_are_not_hidden() -> None:
    samples, weights = histogram(2, 6, 0)
    outer, proposed = histogram(2, 6, 1)
    broken = weights.clone()
    broken[1, 3] = float("nan")
    assert bool(distortion(samples, broken).isnan())
    assert bool(interlevel(samples, broken, [(outer, proposed)]).isnan())
    assert bool(interlevel(samples, weights, [(outer, proposed * float("nan"))]).isnan())


def test_dtypes_that_are_not_compiled_take_the_reference() -> None:
    samples, weights = histogram(2, 6, 0)
    half = Samples(samples.edges.bfloat16(), samples.spacing.bfloat16())
    assert distortion(half, weights.bfloat16()).dtype == torch.bfloat16
