"""The terms that training minimises. Each is a scalar; weights (R, K) are those of `volume_weights`."""

import torch
from torch import Tensor

from qnerf.config.tensors import require_tensor
from qnerf.kernels import histogram
from qnerf.types import Samples

SPREAD = 0.01  # of the distance of a sparse point
LEAST = 1e-3  # added to weights before their logarithm: a ray that misses its point does not drown all others


def mse(color: Tensor, target: Tensor) -> Tensor:
    """Mean squared error of colours (R, 3).

    >>> float(mse(torch.tensor([[0.5, 0.5, 0.0]]), torch.tensor([[0.0, 0.0, 0.5]])))
    0.25
    """
    return torch.nn.functional.mse_loss(color, target)


def interlevel(samples: Samples, weights: Tensor, proposals: list[tuple[Samples, Tensor]]) -> Tensor:
    """Trains each proposal histogram to bound the final one from above (Eq. 13, arXiv:2111.12077).

    The sum over proposals of mean_{R,K} max(0, w - w_outer)^2 / (w + 1e-7). w_outer is the proposal's weight on the
    intervals that touch a final interval. Gradients reach the proposals only.

    >>> edges, outer_edges = torch.tensor([[0.0, 0.5, 1.0]]), torch.tensor([[0.0, 1.0]])
    >>> final, proposal = Samples(edges, edges), Samples(outer_edges, outer_edges)
    >>> weights = torch.tensor([[0.5, 0.25]])
    >>> [round(float(interlevel(final, weights, [(proposal, torch.tensor([[w]]))])), 4) for w in (0.5, 0.0)]
    [0.0, 0.375]

    Args:
        samples: final intervals.
        weights: (R, K) of the final intervals.
        proposals: intervals of each proposal network, and their weights (R, J).
    """
    total = weights.new_zeros(())
    for proposal, proposed in proposals:
        arguments = (samples.spacing.detach(), weights.detach(), proposal.spacing.detach())
        for edges, values in ((arguments[0], weights), (arguments[2], proposed)):
            require_tensor("interlevel: edges", edges, (len(weights), values.shape[-1] + 1))
        total = total + _INTERLEVEL(proposed, *arguments) / weights.numel()
    return total


def interlevel_reference(w_outer: Tensor, s: Tensor, w: Tensor, s_outer: Tensor) -> Tensor:
    """One proposal's term of `interlevel` in plain PyTorch, summed over rays and intervals.

    Sums are in float64. Those of float32 would differ by more than most weights: three quarters of the gradients of a
    trained scene would be rounding errors.
    """
    excess = (w - outer_measure(s, s_outer, w_outer.double())).clamp(min=0)
    return (excess.square() / (w.double() + histogram.EPS)).sum().to(w.dtype)


def outer_measure(edges: Tensor, outer_edges: Tensor, outer_weights: Tensor) -> Tensor:
    """Weight of the outer histogram's intervals that touch each interval (R, K) of `edges` (R, K + 1).

    Args:
        edges: (R, K + 1) non-decreasing.
        outer_edges: (R, J + 1) non-decreasing. Intervals touch also where one begins at the end of the other.
        outer_weights: (R, J).
    """
    cumulative = torch.nn.functional.pad(outer_weights.cumsum(-1), (1, 0))
    above = torch.searchsorted(outer_edges.contiguous(), edges.contiguous(), right=True)
    low = (above[:, :-1] - 1).clamp(min=0)
    high = above[:, 1:].clamp(max=outer_weights.shape[-1])
    return cumulative.gather(-1, high) - cumulative.gather(-1, low)


def sparse_depth(edges: Tensor, weights: Tensor, distances: Tensor) -> Tensor:
    """Cross entropy of where each ray ends and its known distance, as in depth-supervised NeRF (arXiv:2107.02791).

    The known distance is a normal distribution with `SPREAD` of it as its standard deviation. Its mass in each interval
    is exact, so that an interval which is wider than the distribution counts, too.

    >>> edges, known = torch.tensor([[0.0, 1.0, 2.0, 3.0]]), torch.tensor([1.5])
    >>> [round(float(sparse_depth(edges, torch.tensor([w]), known)), 2) for w in ([0.0, 1.0, 0.0], [0.9, 0.1, 0.0])]
    [-0.0, 2.29]

    Args:
        edges: (R, K + 1) world units.
        weights: (R, K).
        distances: (R,) world units, above 0.
    """
    known = distances[:, None]
    below = torch.special.ndtr((edges.detach() - known) / (SPREAD * known))
    return -((below[:, 1:] - below[:, :-1]) * (weights + LEAST).log()).sum(-1).mean()


def distortion(samples: Samples, weights: Tensor) -> Tensor:
    """Distortion loss, which concentrates each ray's weight (Eq. 15, arXiv:2111.12077), in the normalised coordinate s.

    The mean over rays of sum_{i,j} w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 (s_{i+1} - s_i), with interval midpoints m.
    The double sum is computed as 2 sum_k (m_{k+1} - m_k) (w_0 + ... + w_k) (w_{k+1} + ...): all terms are positive, so
    nothing cancels.

    >>> edges = torch.tensor([[0.0, 0.5, 1.0]])
    >>> [round(float(distortion(Samples(edges, edges), torch.tensor([w]))), 4) for w in ([1.0, 0.0], [0.5, 0.5])]
    [0.1667, 0.3333]
    """
    s = require_tensor("distortion: edges", samples.spacing.detach(), (len(weights), weights.shape[-1] + 1))
    total: Tensor = _DISTORTION(weights, s)
    return total / weights.shape[0]


def distortion_reference(weights: Tensor, s: Tensor) -> Tensor:
    """The sum over rays of `distortion`, in plain PyTorch."""
    before = weights[:, :-1].cumsum(-1)
    behind = weights[:, 1:].flip(-1).cumsum(-1).flip(-1)  # total - before would cancel behind a spike
    gaps = s[:, 2:] - s[:, :-2]  # twice the distance of neighbouring midpoints
    between = (gaps * before * behind).sum()
    within = ((s[:, 1:] - s[:, :-1]) * weights.square()).sum() / 3
    return between + within


_INTERLEVEL = histogram.regulariser("interlevel loss", interlevel_reference, histogram.interlevel)
_DISTORTION = histogram.regulariser("distortion loss", distortion_reference, histogram.distortion)
