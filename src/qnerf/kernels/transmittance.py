"""Densities of a ray's intervals -> their weights: a compiled CPU loop each way.

The plain PyTorch reference is `qnerf.rendering.render.volume_weights_reference`.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from qnerf.kernels.derivatives import is_differentiated, through_reference
from qnerf.kernels.exponentials import exp, expm1
from qnerf.kernels.hashgrid import U
from qnerf.kernels.jit import jit, run

GRAIN = 256  # rays that are worth waking a thread for


class VolumeWeights(torch.autograd.Function):
    """Densities (R, K) and lengths (R, K) -> weights (R, K); `reference` is the same in plain PyTorch."""

    @staticmethod
    def forward(ctx: Any, density: Tensor, delta: Tensor, reference: Callable[..., Tensor]) -> Tensor:
        weights, after = torch.empty(2, *density.shape, dtype=density.dtype).unbind()
        rays, count = density.shape
        run(forward, rays, count, density, delta, after, weights, grain=GRAIN)
        ctx.save_for_backward(density, delta, after, weights)
        ctx.reference = reference
        return weights

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        density, delta, after, weights = ctx.saved_tensors
        if is_differentiated(upstream):
            return *through_reference(ctx.reference, (density, delta.detach()), upstream), None
        gradient = torch.empty(density.shape, dtype=density.dtype)
        rays, count = density.shape
        run(backward, rays, count, delta, after, weights, upstream, gradient, grain=GRAIN)
        return gradient, None, None


@jit
def forward(start, stop, count, density, delta, after, weights):  # type: ignore[no-untyped-def]
    """Writes the weights of rays start..stop, and the transmittance behind each interval."""
    number = density.dtype.type
    largest = number(np.finfo(density.dtype).max)
    n = U(count)
    for ray in range(U(start), U(stop)):
        first = ray * n
        # The optical thickness of each interval, and of all up to its end. An infinite density on an interval of length
        # 0 is no thickness.
        total = 0.0
        for i in range(first, first + n):
            weights[i] = (largest if density[i] > largest else density[i]) * delta[i]
            total += weights[i]
            after[i] = total
        # What passes all intervals up to this one, and what this one alone stops. These two loops become vectors.
        for i in range(first, first + n):
            after[i] = exp(-after[i])
        for i in range(first, first + n):
            weights[i] = number(0) - expm1(-weights[i])  # 0, not -0
        for i in range(first + U(1), first + n):
            weights[i] *= after[i - U(1)]


@jit
def backward(start, stop, count, delta, after, weights, upstream, gradient):  # type: ignore[no-untyped-def]
    """Writes the gradients of rays start..stop by density.

    With x = density times length: dw_i / dx_i = T_(i+1), dw_j / dx_i = -w_j for j > i.
    """
    number = delta.dtype.type
    n = U(count)
    for ray in range(U(start), U(stop)):
        # From the end to the start: `behind` sums what an interval takes from those behind it. The own term is not in
        # it, so that nothing cancels on an opaque sample.
        behind = 0.0
        for k in range(n):
            i = (ray + U(1)) * n - U(1) - k
            gradient[i] = (upstream[i] * after[i] - number(behind)) * delta[i]
            behind += upstream[i] * weights[i]
