"""Undistortion where Newton's method does not converge, and what it loses where it does."""

import math

import torch
from hypothesis import given, target
from hypothesis import strategies as st

from qnerf.scenes.lens import ITERATIONS, TOLERANCE, distort, invertible, undistort

POINTS = st.lists(st.tuples(*[st.floats(-1.5, 1.5)] * 2), min_size=1, max_size=6)
ANY_LENS = st.tuples(*[st.floats(-3, 3) | st.sampled_from([0.0, -0.25, 1e3, -1e3])] * 4)
ROUND_TRIP = 2**-44
"""Of points within 1.5 focal lengths that `invertible` vouches for, as the lens sees them: Newton's method converges to
the rounding of a polynomial whose terms reach some 10^2."""


@given(seen=POINTS, lens=ANY_LENS)
def test_undistortion_that_does_not_converge_is_finite_and_told(seen, lens):
    points, coefficients = torch.tensor(seen, dtype=torch.float64), torch.tensor(lens, dtype=torch.float64)
    ideal = undistort(points, coefficients)
    assert bool(ideal.isfinite().all())
    missed = (distort(ideal, coefficients) - points).abs().amax(-1)
    good = invertible(points, coefficients)
    assert not bool((good & (missed > TOLERANCE * (1 + points.abs().amax(-1)))).any())
    assert not bool(invertible(torch.tensor([[math.nan, 0.0]], dtype=torch.float64), coefficients).any())


def test_undistortion_beyond_the_fold_claims_no_point():
    """k1 = -1/3: radius 1 is seen at 2/3, the farthest; nothing is seen beyond."""
    lens = torch.tensor([-1 / 3, 0, 0, 0], dtype=torch.float64)
    radius = torch.tensor([0.0, 0.3, 0.6, 0.66, 0.6667, 0.7, 1.0], dtype=torch.float64)
    seen = torch.stack([radius, torch.zeros(7).double()], dim=-1)
    assert invertible(seen, lens).tolist() == [True, True, True, True, False, False, False]
    assert bool(undistort(seen, lens).isfinite().all())


COEFFICIENT = st.floats(-0.1, 0.1)


@given(ideal=POINTS, lens=st.tuples(COEFFICIENT, st.floats(0, 0.1), *[st.floats(-0.02, 0.02)] * 2))
def test_undistortion_that_converges_is_exact(ideal, lens):
    points, coefficients = torch.tensor(ideal, dtype=torch.float64), torch.tensor(lens, dtype=torch.float64)
    seen = distort(points, coefficients)
    good = invertible(seen, coefficients)
    missed = (distort(undistort(seen, coefficients), coefficients) - seen).abs().amax(-1)
    error = float((missed * good).max())
    target(error)
    assert error <= ROUND_TRIP
    assert ITERATIONS == 10
