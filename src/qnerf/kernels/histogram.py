"""Compiled loops over the histograms of rays: sampling edges, and the interlevel and distortion losses with gradients.

Each goes along a ray once and sums in float64. The plain PyTorch references are in `qnerf.rendering.pdf` and
`qnerf.training.losses`.
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from qnerf.kernels.jit import jit, run
from qnerf.kernels.loop import Loop

EPS = 1e-7  # of the interlevel loss, against division by 0
_GRAIN = 50_000  # weights that are worth waking a thread for


def _array(tensor: Tensor) -> np.ndarray:
    return (tensor.detach() if tensor.requires_grad else tensor).contiguous().numpy()


def _grain(weights: Tensor) -> int:
    return max(_GRAIN // max(weights.shape[1], 1), 1)


@jit
def draw_edges(start, stop, s, w, jitter, padding, min_total, out):  # type: ignore[no-untyped-def]
    """Writes the edges drawn on rays start..stop."""
    bins, count = w.shape[1], out.shape[1]
    for ray in range(start, stop):
        # The whole weight. What an almost empty ray lacks to `min_total` is spread evenly over its intervals.
        total = 0.0
        for j in range(bins):
            total += np.float64(w[ray, j]) + padding
        fill = max(min_total - total, 0.0) / bins
        total += fill * bins
        # Targets grow with k, so one walk along the intervals finds them all: interval j holds the target if the weight
        # `below` it does not reach the target and that up to its end does. The edge lies within it by linear
        # interpolation.
        j = 0
        below = 0.0
        mass = np.float64(w[ray, 0]) + padding + fill
        for k in range(count):
            target = (k + np.float64(jitter[ray])) / count * total
            while j < bins - 1 and below + mass <= target:
                below += mass
                j += 1
                mass = np.float64(w[ray, j]) + padding + fill
            share = 0.0
            if mass > 0:
                share = min(max((target - below) / mass, 0.0), 1.0)
            low, high = np.float64(s[ray, j]), np.float64(s[ray, j + 1])
            out[ray, k] = min(low + share * (high - low), high)


def draw(s: Tensor, w: Tensor, count: int, padding: float, jitter: Tensor | None, min_total: float) -> Tensor:
    """`qnerf.rendering.pdf.sample_edges` for tensors that the loop serves (`dispatch`)."""
    out = torch.empty(s.shape[0], count, dtype=s.dtype)
    offset = torch.full((s.shape[0],), 0.5, dtype=s.dtype) if jitter is None else jitter[:, 0]
    arrays = (_array(s), _array(w), _array(offset))
    run(draw_edges, s.shape[0], *arrays, padding, min_total, out.numpy(), grain=_grain(w))
    return out


@jit
def _interlevel(start, stop, s, w, s_outer, w_outer, eps, loss, grad):  # type: ignore[no-untyped-def]
    """Writes the losses of rays start..stop and their derivatives by the outer weights."""
    bins, outer_bins = w.shape[1], w_outer.shape[1]
    cumulative = np.empty(outer_bins + 1)
    slope = np.empty(outer_bins + 1)
    for ray in range(start, stop):
        # Cumulative outer weights: the weight of the outer intervals from `low` to `high` is a difference of two.
        cumulative[0] = 0.0
        slope[:] = 0.0
        for j in range(outer_bins):
            cumulative[j + 1] = cumulative[j] + w_outer[ray, j]
        above = 0  # outer edges at or below the inner one
        while above <= outer_bins and s_outer[ray, above] <= s[ray, 0]:
            above += 1
        # Edges of both histograms grow, so one walk finds the outer intervals that touch each inner one. The derivative
        # by all outer weights between `low` and `high` is the same number: noted where it begins and where it ends.
        total = 0.0
        for i in range(bins):
            low = max(above - 1, 0)
            while above <= outer_bins and s_outer[ray, above] <= s[ray, i + 1]:
                above += 1
            high = min(above, outer_bins)
            excess = w[ray, i] - (cumulative[high] - cumulative[low])
            if not excess <= 0:  # true for NaN too
                total += excess * excess / (w[ray, i] + eps)
                step = -2 * excess / (w[ray, i] + eps)
                slope[low] += step
                slope[high] -= step
        loss[ray] = total
        # The running sum of these notes is the derivative by each outer weight.
        running = 0.0
        for j in range(outer_bins):
            running += slope[j]
            grad[ray, j] = running


def interlevel(w_outer: Tensor, s: Tensor, w: Tensor, s_outer: Tensor, losses: np.ndarray, gradient: Tensor) -> None:
    """Writes the sum over each ray (R,) of max(0, w - w_outer)^2 / (w + EPS), and the gradients by w_outer.

    w_outer stands for the outer weights of the intervals that touch that of w (Eq. 13, arXiv:2111.12077).
    """
    arrays = map(_array, (s, w, s_outer, w_outer))
    run(_interlevel, len(s), *arrays, EPS, losses, gradient.numpy(), grain=_grain(w_outer))


@jit
def _distortion(start, stop, s, w, loss, grad):  # type: ignore[no-untyped-def]
    """Writes the losses of rays start..stop and their derivatives by the weights."""
    bins = w.shape[1]
    for ray in range(start, stop):
        # With W_k = w_0 + ... + w_k, W their sum and gap_k = s_(k+2) - s_k, twice the distance of two midpoints:
        # L = sum_i w_i (sum_{k<i} gap_k W_k + 1/3 w_i (s_(i+1) - s_i)); every term is positive, so nothing cancels.
        # dL/dw_i = sum_{k<i} gap_k W_k + sum_{k>=i} gap_k (W - W_k) + 2/3 w_i (s_(i+1) - s_i)
        # One walk forward sums what lies before each interval, and a walk back what lies behind it.
        before = 0.0
        cumulative = 0.0
        total = 0.0
        for i in range(bins):
            weight = np.float64(w[ray, i])
            length = np.float64(s[ray, i + 1]) - s[ray, i]
            grad[ray, i] = before + 2 / 3 * weight * length
            cumulative += weight
            total += weight * (before + weight * length / 3)
            if i < bins - 1:
                before += (np.float64(s[ray, i + 2]) - s[ray, i]) * cumulative
        behind = 0.0
        cumulative = 0.0
        for i in range(bins - 1, -1, -1):
            if i < bins - 1:
                behind += (np.float64(s[ray, i + 2]) - s[ray, i]) * cumulative
            cumulative += w[ray, i]
            grad[ray, i] += behind
        loss[ray] = total


def distortion(w: Tensor, s: Tensor, losses: np.ndarray, gradient: Tensor) -> None:
    """Writes the distortion loss (Eq. 15, arXiv:2111.12077) of each ray (R,), and the gradients by w."""
    run(_distortion, len(w), _array(s), _array(w), losses, gradient.numpy(), grain=_grain(w))


def regulariser(name: str, reference: Callable[..., Tensor], loop: Callable[..., None]) -> Loop:
    """The sum over rays of `interlevel` or `distortion`, differentiated by the first tensor, which is the weights."""

    def forward(keeps: bool, weights: Tensor, *others: Tensor) -> tuple[Tensor, tuple[Tensor]]:
        losses, gradient = np.empty(len(weights)), torch.empty_like(weights, memory_format=torch.contiguous_format)
        loop(weights, *others, losses, gradient)
        return torch.tensor(losses.sum(), dtype=weights.dtype), (gradient,)

    return Loop(name, reference, forward, lambda needs, inputs, kept, upstream: (upstream * kept[0],))
