"""Drawing from histograms, spacing curves and samplers on the inputs at which float32 gives up."""

import math
from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given, target
from hypothesis import strategies as st

from benchmarks.accuracy_cases import rounded
from benchmarks.accuracy_cases.sampling import SPACED
from qnerf.kernels import plain
from qnerf.rendering.pdf import sample_edges
from qnerf.rendering.samplers import SAMPLERS
from qnerf.rendering.spacing import SPACINGS
from tests.helpers.hard_inputs import seeds
from tests.rendering.test_samplers import make, make_rays

LEAST = Fraction(1e-5)  # of all weights together: below, the histogram is filled up evenly
SLACK = 2.0**-46
"""Of the distribution at a drawn edge, relative to the whole: the loop adds at most 64 numbers in float64."""
WEIGHTS = st.sampled_from([0.0, 1e-38, 1e-12, 1.0]) | st.floats(0, 1, width=32)
EDGES = st.sampled_from([0.0, 0.25, 0.5, 1.0]) | st.floats(0, 1, width=32)


def cumulative(edges, masses, at, right):
    """Mass below `at`, with or without what lies exactly there, in rational numbers."""
    total = Fraction(0)
    for low, high, mass in zip(edges[:-1], edges[1:], masses, strict=True):
        if high < at or (right and high == at):
            total += mass
        elif low < at < high:
            total += mass * (Fraction(at) - Fraction(low)) / (Fraction(high) - Fraction(low))
        elif high == at and low < at:
            total += mass
    return total


@given(
    histogram=st.lists(st.tuples(EDGES, WEIGHTS), min_size=1, max_size=12),
    count=st.integers(1, 12),
    padding=st.sampled_from([0.0, 0.01]),
    jitter=st.none() | st.floats(0, 1, exclude_max=True, width=32),
)
def test_drawn_edges_lie_where_the_distribution_says(histogram, count, padding, jitter):
    """One float32 below an edge the exact distribution is at most its share, one above at least."""
    edges = [0.0, *sorted(edge for edge, _ in histogram)]
    weights = [Fraction(weight) + Fraction(padding) for _, weight in histogram]
    fill = max(LEAST - sum(weights), Fraction(0)) / len(weights)
    masses = [weight + fill for weight in weights]
    s, w = torch.tensor([edges], dtype=torch.float32), torch.tensor([[w for _, w in histogram]], dtype=torch.float32)
    offset = None if jitter is None else torch.tensor([[jitter]], dtype=torch.float32)
    found = sample_edges(s, w, count, padding=padding, jitter=offset)[0].numpy()
    whole = sum(masses)
    for k, edge in enumerate(found):
        share = (k + Fraction(0.5 if jitter is None else jitter)) / count * whole
        below, above = (float(np.nextafter(edge, np.float32(end))) for end in (-1, 2))
        assert cumulative(edges, masses, below, right=False) <= share + Fraction(SLACK) * whole
        assert cumulative(edges, masses, above, right=True) >= share - Fraction(SLACK) * whole


@pytest.mark.parametrize("name", SPACINGS.names())
@given(
    near=st.floats(2**-10, 1e3, width=32),
    ratio=st.floats(1.0009765625, 1e6, width=32),
    s=st.lists(st.floats(0, 1, width=32), min_size=1, max_size=30),
)
def test_distances_of_every_spacing(name, near, ratio, s):
    bounds = rounded([[near]]), rounded([[near * ratio]])
    at = rounded([s])
    exact = SPACINGS.build(name, *bounds).to_world(at)
    found = SPACINGS.build(name, *(bound.float() for bound in bounds)).to_world(at.float())
    error = float(((found.double() - exact) / exact).abs().max())
    target(error)
    assert error <= SPACED


@pytest.fixture(scope="module")
def samplers():
    return {name: make(name) for name in SAMPLERS.names()}


@pytest.mark.parametrize("name", sorted(set(SAMPLERS.names()) - {"disparity", "geometric"}))  # which need near above 0
@given(seed=seeds, at=st.floats(0, 1e6), opacity=st.sampled_from([0.0, 1e-38, 1.0, 1e10, math.inf]))
def test_edges_of_every_sampler_are_ordered_from_near_0_to_far_1e6(samplers, name, seed, at, opacity):
    """Whatever one shell of density makes of the weights: nothing, 1e-38, one spike."""

    def density(points):
        return torch.where(points.norm(dim=-1) >= at, opacity, 0.0)

    generator = torch.Generator().manual_seed(seed)
    found = samplers[name](make_rays(4, near=0.0, far=1e6), density, generator=generator, step=2000)
    for samples in [found.samples, *(samples for samples, _ in found.proposals)]:
        for edges, far in ((samples.edges, 1e6 * (1 + SPACED)), (samples.spacing, 1)):
            assert bool((edges.diff() >= 0).all())
            assert bool((edges >= 0).all())
            assert bool((edges <= far).all())


@given(seed=seeds, bins=st.integers(1, 64), count=st.integers(1, 64), power=st.sampled_from([0, 1, 8, 40]))
def test_sample_edges_in_plain_form_are_the_same_in_float64(seed, bins, count, power):
    """In float64 both agree as far as the distribution does: 1e-9 of [0, 1] at a padding of 0.01."""
    generator = torch.Generator().manual_seed(seed)
    s = torch.rand(3, bins + 1, generator=generator, dtype=torch.float64).sort(-1).values
    w = torch.rand(3, bins, generator=generator, dtype=torch.float64).pow(power)
    fast = sample_edges(s, w, count)
    with plain():
        torch.testing.assert_close(fast, sample_edges(s, w, count), rtol=0, atol=1e-9)
