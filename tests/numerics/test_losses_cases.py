"""The regularisers with coincident edges and weights of nothing, against sums over all pairs."""

import math
from contextlib import nullcontext

import numpy as np
import pytest
import torch
from hypothesis import given, target
from hypothesis import strategies as st

from benchmarks.accuracy_cases import EPS, rounded
from benchmarks.accuracy_cases.losses import LOSSES
from qnerf.kernels import plain
from qnerf.training.losses import distortion, interlevel
from qnerf.types import Samples

PLAIN = 64 * EPS
"""Of the plain forms, relative to the sum of all products: they add at most 12 numbers, each of up to 5 roundings."""
BOUNDS = {"fast": LOSSES, "plain": PLAIN}
UNDERFLOW = 1e-37
"""A loss of that size or less may lose its digits: float32 has none there."""

EDGE = st.sampled_from([0.0, 0.25, 0.5, 1.0]) | st.floats(0, 1, width=32)
WEIGHT = st.sampled_from([0.0, 1e-38, 1e-7, 0.5]) | st.floats(0, 1, width=32)
HISTOGRAM = st.lists(st.tuples(EDGE, WEIGHT), min_size=1, max_size=12)


def split(histogram):
    """Sorted edges that begin at 0, and weights."""
    edges = [0.0, *sorted(edge for edge, _ in histogram)]
    return rounded(edges).numpy(), rounded([weight for _, weight in histogram]).numpy()


def evaluated(form, function, *tensors):
    """A loss of (1, K) float32 tensors and its gradient in the first."""
    first, *others = (torch.from_numpy(t).float()[None] for t in tensors)
    first.requires_grad_()
    with plain() if form == "plain" else nullcontext():
        loss = function(first, *others)
    (gradient,) = torch.autograd.grad(loss, first)
    return float(loss.detach()), gradient[0].double().numpy()


def spread(weights, s):
    return distortion(Samples(s, s), weights)


def uncovered(proposed, s, weights, outer):
    return interlevel(Samples(s, s), weights, [(Samples(outer, outer), proposed)])


@pytest.mark.parametrize("form", BOUNDS)
@given(histogram=HISTOGRAM)
def test_distortion_against_all_pairs_with_coincident_edges(form, histogram):
    edges, weights = split(histogram)
    mids = (edges[1:] + edges[:-1]) / 2
    apart = np.abs(mids[:, None] - mids)
    exact = math.fsum((np.outer(weights, weights) * apart).ravel()) + math.fsum(weights**2 * np.diff(edges)) / 3
    slope = 2 * (apart * weights).sum(1) + 2 / 3 * weights * np.diff(edges)
    loss, gradient = evaluated(form, spread, weights, edges)
    error = abs(loss - exact) / max(exact, UNDERFLOW)
    target(error)
    assert error <= BOUNDS[form]
    assert np.abs(gradient - slope).max() <= BOUNDS[form] * max(slope.max(), UNDERFLOW)


@pytest.mark.parametrize("form", BOUNDS)
@given(inner=HISTOGRAM, outer=HISTOGRAM)
def test_interlevel_against_its_definition_with_zero_weights(form, inner, outer):
    (edges, weights), (outer_edges, proposed) = split(inner), split(outer)
    exact, slope = 0.0, np.zeros(len(proposed))
    for low, high, weight in zip(edges[:-1], edges[1:], weights, strict=True):
        first = max(np.searchsorted(outer_edges, low, side="right") - 1, 0)
        last = min(np.searchsorted(outer_edges, high, side="right"), len(proposed))
        excess = weight - math.fsum(proposed[first:last])
        if excess > 0:
            exact += excess**2 / (weight + 1e-7) / len(weights)
            slope[first:last] -= 2 * excess / (weight + 1e-7) / len(weights)
    loss, gradient = evaluated(form, uncovered, proposed, edges, weights, outer_edges)
    slack = 1e-12
    assert abs(loss - exact) <= BOUNDS[form] * exact + slack * (2 * math.sqrt(exact) + slack / 1e-7) + UNDERFLOW
    assert np.abs(gradient - slope).max() <= BOUNDS[form] * np.abs(slope).max() + 1e-8
