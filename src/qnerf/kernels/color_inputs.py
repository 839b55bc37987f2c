"""What a colour head gets for each point with a colour: a compiled CPU loop each way.

The plain PyTorch reference is in `qnerf.model.field.color_inputs`.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from qnerf.kernels.derivatives import is_differentiated, through_reference
from qnerf.kernels.hashgrid import U, flat
from qnerf.kernels.jit import jit, run

GRAIN = 256  # rays that are worth waking a thread for


class ColorInputs(torch.autograd.Function):
    """Features of rays (R, D) and geometry (R, M, G) -> rows (N, D + G) of the N chosen points, ray by ray.

    Args:
        chosen: (R, M) bool.
        reference: rays, geometry -> the same in plain PyTorch, for second derivatives.

    Returns:
        The rows, and the numbers (N,) int64 of the chosen points among all.
    """

    @staticmethod
    def forward(
        ctx: Any, of_rays: Tensor, geometry: Tensor, chosen: Tensor, reference: Callable[..., Tensor]
    ) -> tuple[Tensor, Tensor]:
        rays, points, features = geometry.shape
        mask = chosen.numpy()
        ends = np.cumsum(np.count_nonzero(mask, axis=1))
        rows = geometry.new_empty(int(ends[-1]), of_rays.shape[1] + features)
        index = torch.empty(len(rows), dtype=torch.int64)
        sizes = (points, of_rays.shape[1], features)
        run(
            _gather,
            rays,
            *sizes,
            flat(of_rays),
            flat(geometry),
            flat(chosen),
            ends,
            flat(rows),
            flat(index),
            grain=GRAIN,
        )
        ctx.save_for_backward(of_rays, geometry, chosen)
        ctx.sizes, ctx.ends, ctx.reference = sizes, ends, reference
        ctx.mark_non_differentiable(index)
        return rows, index

    @staticmethod
    def backward(ctx: Any, upstream: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        of_rays, geometry, chosen = ctx.saved_tensors
        if is_differentiated(upstream):
            return *through_reference(ctx.reference, (of_rays, geometry), upstream), None, None
        to_rays, to_geometry = of_rays.new_zeros(of_rays.shape), geometry.new_zeros(geometry.shape)
        arrays = (flat(upstream), flat(chosen), ctx.ends, flat(to_rays), flat(to_geometry))
        run(_gather_gradient, len(geometry), *ctx.sizes, *arrays, grain=GRAIN)
        return to_rays if ctx.needs_input_grad[0] else None, to_geometry, None, None


@jit
def _gather(start, stop, points, width, features, of_rays, geometry, chosen, ends, rows, index):  # type: ignore[no-untyped-def]
    """Writes the rows of rays start..stop. Those of a ray begin where those of the one before end."""
    m, d, g = U(points), U(width), U(features)
    for ray in range(start, stop):
        row = U(ends[ray - 1]) if ray else U(0)
        for i in range(U(ray) * m, (U(ray) + U(1)) * m):
            if chosen[i]:
                index[row] = i
                first = row * (d + g)
                for k in range(d):
                    rows[first + k] = of_rays[U(ray) * d + k]
                for k in range(g):
                    rows[first + d + k] = geometry[i * g + k]
                row += U(1)


@jit
def _gather_gradient(start, stop, points, width, features, upstream, chosen, ends, to_rays, to_geometry):  # type: ignore[no-untyped-def]
    """Writes the gradients of rays start..stop into arrays of zeros."""
    m, d, g = U(points), U(width), U(features)
    for ray in range(start, stop):
        row = U(ends[ray - 1]) if ray else U(0)
        for i in range(U(ray) * m, (U(ray) + U(1)) * m):
            if chosen[i]:
                first = row * (d + g)
                for k in range(d):
                    to_rays[U(ray) * d + k] += upstream[first + k]
                for k in range(g):
                    to_geometry[i * g + k] = upstream[first + d + k]
                row += U(1)
