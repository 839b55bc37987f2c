"""What training minimises. Each loss is a scalar; weights (R, K) are those of volume rendering."""

import torch
from torch import Tensor

from qnerf.kernels import compiled, histogram
from qnerf.types import Samples

_EPS = 1e-7


def mse(color: Tensor, target: Tensor) -> Tensor:
    """Mean squared error of colours (R, 3)."""
    return torch.nn.functional.mse_loss(color, target)


def interlevel(samples: Samples, weights: Tensor, proposals: list[tuple[Samples, Tensor]]) -> Tensor:
    """Asks each proposal histogram to bound the final one from above (Eq. 13, arXiv:2111.12077).

    sum over proposals of mean_{R,K} max(0, w - w_outer)^2 / (w + 1e-7), where w_outer is what the proposal has on the
    intervals that a final interval touches. Gradients reach the proposals only.
    """
    total = weights.new_zeros(())
    for proposal, proposed in proposals:
        arguments = (samples.spacing.detach(), weights.detach(), proposal.spacing.detach())
        if compiled(proposed, *arguments):
            total = total + histogram.Interlevel.apply(proposed, *arguments, _EPS) / weights.numel()
        else:
            total = total + interlevel_reference(proposed, *arguments) / weights.numel()
    return total


def interlevel_reference(w_outer: Tensor, s: Tensor, w: Tensor, s_outer: Tensor) -> Tensor:
    """The sum over rays and intervals of `interlevel` for one proposal, in plain PyTorch."""
    excess = (w - outer_measure(s, s_outer, w_outer)).clamp(min=0)
    return (excess.square() / (w + _EPS)).sum()


def outer_measure(edges: Tensor, outer_edges: Tensor, outer_weights: Tensor) -> Tensor:
    """Weight of the outer histogram's intervals that touch each interval (R, K) of `edges` (R, K + 1).

    Args:
        edges: (R, K + 1) non-decreasing.
        outer_edges: (R, J + 1) non-decreasing; an interval that begins where one of `edges` ends touches it.
        outer_weights: (R, J).
    """
    cumulative = torch.nn.functional.pad(outer_weights.cumsum(-1), (1, 0))
    above = torch.searchsorted(outer_edges.contiguous(), edges.contiguous(), right=True)
    low = (above[:, :-1] - 1).clamp(min=0)
    high = above[:, 1:].clamp(max=outer_weights.shape[-1])
    return cumulative.gather(-1, high) - cumulative.gather(-1, low)


def distortion(samples: Samples, weights: Tensor) -> Tensor:
    """Pulls each ray's weight together (Eq. 15, arXiv:2111.12077), in the normalised coordinate s.

    mean over rays of sum_{i,j} w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 (s_{i+1} - s_i), m the interval midpoints. The
    double sum is 2 sum_k (m_{k+1} - m_k) W_k (w_{k+1} + ...) with W_k = w_0 + ... + w_k: all its terms are positive and
    no digits cancel.
    """
    s = samples.spacing.detach()
    if compiled(weights, s):
        return histogram.Distortion.apply(weights, s) / weights.shape[0]
    return distortion_reference(weights, s) / weights.shape[0]


def distortion_reference(weights: Tensor, s: Tensor) -> Tensor:
    """The sum over rays of `distortion`, in plain PyTorch."""
    before = weights[:, :-1].cumsum(-1)
    behind = weights[:, 1:].flip(-1).cumsum(-1).flip(-1)  # the total less `before` would cancel behind a spike
    gaps = s[:, 2:] - s[:, :-2]  # twice the distance of neighbouring midpoints
    between = (gaps * before * behind).sum()
    within = ((s[:, 1:] - s[:, :-1]) * weights.square()).sum() / 3
    return between + within
