"""Coarse to fine: features of high frequency enter one after another during training."""

import math

import torch
from torch import Tensor


def window_weights(count: int, progress: float, share: float) -> Tensor | None:
    """Weights (count,) in [0, 1], float64, of frequency bands or grid levels, coarsest first; None once all are 1.

    The coarser half is active from the start, all of them after `share` of the training. `progress` is the share of the
    training that is done. The k-th weight is (1 - cos(pi clamp(a - k, 0, 1))) / 2 with
    a = count (1 + progress / share) / 2 (Eq. 14, arXiv:2104.06405).

    >>> window_weights(4, progress=0.0, share=0.5).tolist()
    [1.0, 1.0, 0.0, 0.0]
    """
    if progress >= share:
        return None
    active = count * (1 + progress / share) / 2
    return (1 - torch.cos(math.pi * (active - torch.arange(count, dtype=torch.float64)).clamp(0, 1))) / 2
