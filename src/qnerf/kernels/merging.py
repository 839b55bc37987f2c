"""Neighbouring samples of a ray merged into parts of equal weight: a compiled CPU loop each way.

The plain PyTorch reference is in `qnerf.rendering.shading`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from qnerf.kernels.derivatives import is_differentiated, through_reference
from qnerf.kernels.hashgrid import U, flat
from qnerf.kernels.jit import jit, run

GRAIN = 64  # rays that are worth waking a thread for
Reference = Callable[..., tuple[Tensor, Tensor]]


class Merge(torch.autograd.Function):
    """Shares (R, K), geometry (R, K, G) -> the parts' shares (R, M) and mean geometry (R, M, G); see `MergeShading`.

    Args:
        parts: M.
        floor: the smallest share of a part by which the derivative of its mean is divided.
        reference: shares, geometry, parts -> the same in plain PyTorch, for second derivatives.
    """

    @staticmethod
    def forward(
        ctx: Any, shares: Tensor, geometry: Tensor, parts: int, floor: float, reference: Reference
    ) -> tuple[Tensor, Tensor]:
        rays, count = shares.shape
        merged = shares.new_empty(rays, parts)
        mean = shares.new_empty(rays, parts, geometry.shape[-1])
        part = np.empty(shares.numel(), np.int32)
        tiny = torch.finfo(shares.dtype).tiny
        arrays = (flat(shares), flat(geometry), count, parts, tiny, part, flat(merged), flat(mean))
        run(_merge, rays, *arrays, grain=GRAIN)
        ctx.save_for_backward(shares, geometry, merged, mean)
        ctx.part, ctx.floor, ctx.reference = part, floor, reference
        return merged, mean

    @staticmethod
    def backward(ctx: Any, to_merged: Tensor, to_mean: Tensor) -> tuple[Tensor | None, ...]:
        shares, geometry, merged, mean = ctx.saved_tensors
        if is_differentiated(to_merged, to_mean):
            reference = partial(ctx.reference, parts=merged.shape[1])
            return *through_reference(reference, (shares, geometry), (to_merged, to_mean)), None, None, None
        to_shares = torch.empty_like(shares, memory_format=torch.contiguous_format)
        to_geometry = torch.empty_like(geometry, memory_format=torch.contiguous_format)
        tiny = torch.finfo(shares.dtype).tiny
        inputs = (flat(shares), flat(geometry), flat(merged), flat(mean), ctx.part, flat(to_merged), flat(to_mean))
        sizes = (shares.shape[1], merged.shape[1], tiny, ctx.floor)
        run(_merge_gradient, len(shares), *inputs, *sizes, flat(to_shares), flat(to_geometry), grain=GRAIN)
        return to_shares, to_geometry, None, None, None


@jit
def _merge(start, stop, shares, geometry, count, parts, tiny, part, merged, mean):  # type: ignore[no-untyped-def]
    """Writes the parts of rays start..stop, and of which part each sample is."""
    number = shares.dtype.type
    features = U(mean.size // merged.size)
    n, m = U(count), U(parts)
    for ray in range(U(start), U(stop)):
        first, out = ray * n, ray * m
        total = number(0)
        for i in range(first, first + n):
            total += shares[i]
        total = max(total, number(tiny))
        for j in range(out, out + m):
            merged[j] = number(0)
        # A sample's part is that of the middle of its share, in a running sum that ends at 1. Sums are in float32 or
        # float64 as the reference's are, in the same order, so that both choose the same part.
        before = number(0)
        for i in range(first, first + n):
            before += shares[i]
            middle = (before - shares[i] / number(2)) / total
            own = min(max(np.int64(middle * number(parts)), 0), parts - 1)
            part[i] = own
            merged[out + U(own)] += shares[i]
        for j in range(out * features, (out + m) * features):
            mean[j] = number(0)
        # The mean geometry of each part, weighted by the samples' shares of it.
        for i in range(first, first + n):
            own = out + U(part[i])
            weight = shares[i] / max(merged[own], number(tiny))
            for f in range(features):
                mean[own * features + f] += weight * geometry[i * features + f]


@jit
def _merge_gradient(  # type: ignore[no-untyped-def]
    start, stop, shares, geometry, merged, mean, part, to_merged, to_mean, count, parts, tiny, floor, to_shares,
    to_geometry,
):  # fmt: skip
    """Writes the gradients of rays start..stop.

    The derivative of a part's mean m by a sample's share is (g - m) / S, with S of at least `floor`.
    """
    number = shares.dtype.type
    features = U(mean.size // merged.size)
    n, m = U(count), U(parts)
    for ray in range(U(start), U(stop)):
        for i in range(ray * n, (ray + U(1)) * n):
            own = ray * m + U(part[i])
            weight = shares[i] / max(merged[own], number(tiny))
            # Through the mean and through the part's share. A sample of a part with next to no share gets a bounded
            # gradient, see `MergeShading`.
            inner = number(0)
            for f in range(features):
                g = to_mean[own * features + f]
                inner += g * (geometry[i * features + f] - mean[own * features + f])
                to_geometry[i * features + f] = g * weight
            to_shares[i] = to_merged[own] + inner / max(merged[own], number(floor))
