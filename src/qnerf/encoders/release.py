"""Coarse to fine: features of high frequency enter one after another while training goes on."""

import math

import torch
from torch import Tensor


def released(count: int, step: int, steps: int) -> Tensor | None:
    """Weights (count,) in [0, 1] of bands or levels, coarsest first, at a training step; None once all are 1.

    The first half is there from the beginning, the last one is from `steps` on. With a = count (1 + step / steps) / 2
    the k-th has weight (1 - cos(pi clamp(a - k, 0, 1))) / 2 (Eq. 14, arXiv:2104.06405).
    """
    if step >= steps:
        return None
    place = count * (1 + step / steps) / 2
    return (1 - torch.cos(math.pi * (place - torch.arange(count)).clamp(0, 1))) / 2
