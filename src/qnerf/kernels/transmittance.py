"""Densities of a ray's intervals -> their weights: a compiled CPU loop each way.

The plain PyTorch reference is `qnerf.rendering.render.volume_weights_reference`.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from qnerf.kernels.exponentials import exp, expm1
from qnerf.kernels.hashgrid import U
from qnerf.kernels.jit import jit, run

GRAIN = 256  # rays that are worth waking a thread for


def volume_weights(keeps: bool, density: Tensor, delta: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Densities (R, K) and lengths (R, K) -> weights (R, K)."""
    weights, after = torch.empty(2, *density.shape, dtype=density.dtype).unbind()
    rays, count = density.shape
    run(forward, rays, count, density, delta, after, weights, grain=GRAIN)
    return weights, (after, weights)


def volume_weights_gradient(
    needs: Sequence[bool], inputs: Sequence[Tensor], kept: Sequence[Tensor], upstream: Tensor
) -> tuple[Tensor]:
    (_, delta), (after, weights) = inputs, kept
    gradient = torch.empty(delta.shape, dtype=delta.dtype)
    rays, count = delta.shape
    run(backward, rays, count, delta, after, weights, upstream, gradient, grain=GRAIN)
    return (gradient,)


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
