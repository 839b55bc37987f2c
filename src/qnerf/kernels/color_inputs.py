"""What a colour head gets for each point with a colour: a compiled CPU loop each way.

The plain PyTorch reference is in `qnerf.model.field.color_inputs`.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from qnerf.kernels.derivatives import is_differentiated, through_reference
from qnerf.kernels.hashgrid import U
from qnerf.kernels.jit import Call, flat, jit, prepared

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
        ctx.ends = np.cumsum(np.count_nonzero(chosen.numpy(), axis=1))
        rows = geometry.new_empty(int(ctx.ends[-1]), of_rays.shape[1] + geometry.shape[2])
        index = torch.empty(len(rows), dtype=torch.int64)
        gather(of_rays, geometry, chosen, ctx.ends, rows, index)()
        ctx.save_for_backward(of_rays, geometry, chosen)
        ctx.reference = reference
        ctx.mark_non_differentiable(index)
        return rows, index

    @staticmethod
    def backward(ctx: Any, upstream: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        of_rays, geometry, chosen = ctx.saved_tensors
        if is_differentiated(upstream):
            return *through_reference(ctx.reference, (of_rays, geometry), upstream), None, None
        to_rays, to_geometry = of_rays.new_empty(of_rays.shape), geometry.new_empty(geometry.shape)
        gather_gradient(chosen, ctx.ends, to_rays, to_geometry)(flat(upstream))
        return to_rays if ctx.needs_input_grad[0] else None, to_geometry, None, None


def gather(of_rays: Tensor, geometry: Tensor, chosen: Tensor, ends: np.ndarray, rows: Tensor, index: Tensor) -> Call:
    """Writes rows and numbers as in `ColorInputs`. `ends` (R,) says how many rows there are up to the end of a ray."""
    sizes = (geometry.shape[1], of_rays.shape[1], geometry.shape[2])
    return prepared(_gather, len(geometry), *sizes, of_rays, geometry, chosen, ends, rows, index, grain=GRAIN)


def gather_gradient(chosen: Tensor, ends: np.ndarray, to_rays: Tensor, to_geometry: Tensor) -> Call:
    """Writes the gradients of the features of rays and of the geometry, for those of the rows, which the call gets."""
    sizes = (to_geometry.shape[1], to_rays.shape[1], to_geometry.shape[2])
    arrays = (chosen, ends, to_rays, to_geometry)
    return prepared(_gather_gradient, len(to_geometry), *sizes, *arrays, grain=GRAIN)


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
def _gather_gradient(start, stop, points, width, features, chosen, ends, to_rays, to_geometry, upstream):  # type: ignore[no-untyped-def]
    """Writes the gradients of rays start..stop."""
    number = upstream.dtype.type
    m, d, g = U(points), U(width), U(features)
    for ray in range(start, stop):
        row = U(ends[ray - 1]) if ray else U(0)
        for k in range(U(ray) * d, (U(ray) + U(1)) * d):
            to_rays[k] = number(0)
        for i in range(U(ray) * m, (U(ray) + U(1)) * m):
            first = row * (d + g)
            if chosen[i]:
                for k in range(d):
                    to_rays[U(ray) * d + k] += upstream[first + k]
                row += U(1)
            for k in range(g):
                to_geometry[i * g + k] = upstream[first + d + k] if chosen[i] else number(0)
