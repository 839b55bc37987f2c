"""What the searches for worst inputs share."""

import torch
from hypothesis import strategies as st
from torch import Tensor

TINY = torch.finfo(torch.float32).tiny
"""Least normal float32: below it numbers have few digits, and exp gives 0."""

seeds = st.integers(0, 2**31 - 1)


def rounded(values: object) -> Tensor:
    """The nearest numbers that float32 holds, in float64: what both dtypes can start from."""
    return torch.as_tensor(values, dtype=torch.float32).double()


def distance(found: Tensor, exact: Tensor) -> float:
    """Largest difference, in float64; NaN if there is one anywhere."""
    return float((found.detach().double() - exact.detach().double()).abs().amax()) if exact.numel() else 0.0
