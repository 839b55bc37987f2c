"""Inverse-transform sampling: new interval edges on each ray, drawn from a histogram of weights."""

import torch
from torch import Tensor

from qnerf.config.tensors import require_tensor
from qnerf.kernels import histogram
from qnerf.kernels.dispatch import serves

MIN_TOTAL = 1e-5  # a smaller sum of weights is filled up evenly, so an empty ray is sampled evenly


def sample_edges(s: Tensor, w: Tensor, count: int, *, padding: float = 0.01, jitter: Tensor | None = None) -> Tensor:
    """Draws `count` ordered edges by inverting the cumulative distribution of a histogram.

    The k-th edge lies where the distribution reaches (k + jitter) / count. One random offset per ray keeps the edges
    stratified.

    >>> edges, weights = torch.tensor([[0.0, 0.5, 1.0]]), torch.tensor([[3.0, 1.0]])
    >>> [round(edge, 4) for edge in sample_edges(edges, weights, 4, padding=0.0)[0].tolist()]
    [0.0833, 0.25, 0.4167, 0.75]

    Args:
        s: (R, J + 1) edges of the histogram.
        w: (R, J) weights >= 0; they need not sum to 1.
        count: edges to draw.
        padding: added to every weight, so that every interval can still be sampled.
        jitter: (R, 1) in [0, 1); None: 1/2.

    Returns:
        (R, count) non-decreasing, within [s_0, s_J], detached.
    """
    s, w = s.detach(), w.detach()
    require_tensor("sample_edges: s", s, (len(w), w.shape[-1] + 1))
    if serves("drawing edges", s, w):
        return histogram.draw(s, w, count, padding, jitter, MIN_TOTAL)
    return sample_edges_reference(s, w, count, padding=padding, jitter=jitter)


def sample_edges_reference(s: Tensor, w: Tensor, count: int, *, padding: float, jitter: Tensor | None) -> Tensor:
    """`sample_edges` in plain PyTorch."""
    w = w + padding
    w = w + (MIN_TOTAL - w.sum(-1, keepdim=True)).clamp(min=0) / w.shape[-1]
    cdf = torch.nn.functional.pad(w.cumsum(-1), (1, 0))
    cdf = (cdf / cdf[:, -1:]).cummax(-1).values  # a parallel scan may decrease by a rounding error
    k = torch.arange(count, dtype=s.dtype, device=s.device)
    u = ((k + (0.5 if jitter is None else jitter)) / count).expand(s.shape[0], count).contiguous()
    above = torch.searchsorted(cdf, u, right=True).clamp_(1, w.shape[-1])
    below = above - 1
    c0, c1 = cdf.gather(-1, below), cdf.gather(-1, above)
    s0, s1 = s.gather(-1, below), s.gather(-1, above)
    share = ((u - c0) / (c1 - c0)).nan_to_num_(0, 0, 0).clamp_(0, 1)
    return torch.minimum(s0 + share * (s1 - s0), s1)
