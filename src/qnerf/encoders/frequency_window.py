"""Coarse to fine: features of high frequency enter one after another while training goes on."""

import math

import torch
from torch import Tensor


def window_weights(count: int, progress: float, share: float) -> Tensor | None:
    """Weights (count,) in [0, 1], float64, of bands or levels, coarsest first, at `progress` 0..1 of the training; None
    once all are 1.

    The first half is there from the beginning, the last one from the `share` of the training on. With
    a = count (1 + progress / share) / 2 the k-th has weight (1 - cos(pi clamp(a - k, 0, 1))) / 2 (Eq. 14,
    arXiv:2104.06405).
    """
    if progress >= share:
        return None
    place = count * (1 + progress / share) / 2
    return (1 - torch.cos(math.pi * (place - torch.arange(count, dtype=torch.float64)).clamp(0, 1))) / 2
