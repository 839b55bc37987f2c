"""What the searches for worst inputs share."""

import math

import torch
from hypothesis import strategies as st

from benchmarks.accuracy import errors, exact
from benchmarks.accuracy_cases import bound_in

TINY = torch.finfo(torch.float32).tiny
"""Least normal float32: below it numbers have few digits, and exp gives 0."""

seeds = st.integers(0, 2**31 - 1)


def distance(found, exact):
    """Largest difference, in float64; NaN if there is one anywhere."""
    return float((found.detach().double() - exact.detach().double()).abs().amax()) if exact.numel() else 0.0


def held(case):
    """Every variant that has bounds keeps them, in float32 and float64."""
    expected = exact(case)
    for dtype in case.dtypes:
        for variant in case.variants:
            forward, gradient = errors(case, variant, dtype, expected)
            assert math.isfinite(forward), (case.id, variant, dtype)
            if variant in case.bounded:
                assert forward <= bound_in(dtype, case.bound), (case.id, variant, dtype)
                assert case.gradient is None or gradient <= bound_in(dtype, case.gradient), (case.id, variant, dtype)
