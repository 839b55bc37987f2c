"""What a colour head gets for each point with a colour: a compiled CPU loop each way.

The plain PyTorch reference is in `qnerf.model.field.color_inputs`.
"""

import numpy as np
from torch import Tensor

from qnerf.kernels.hashgrid import U
from qnerf.kernels.jit import Call, jit, prepared

GRAIN = 256  # rays that are worth waking a thread for


def gather(of_rays: Tensor, geometry: Tensor, chosen: Tensor, ends: np.ndarray, rows: Tensor) -> Call:
    """Writes rows (N, D + G): features of rays (R, D) beside the geometry (R, M, G) of their `chosen` points (R, M).

    `ends` (R,) says how many rows there are up to the end of each ray.
    """
    sizes = (geometry.shape[1], of_rays.shape[1], geometry.shape[2])
    return prepared(_gather, len(geometry), *sizes, of_rays, geometry, chosen, ends, rows, grain=GRAIN)


def gather_gradient(chosen: Tensor, ends: np.ndarray, to_rays: Tensor, to_geometry: Tensor) -> Call:
    """Writes the gradients of the features of rays and of the geometry, for those of the rows, which the call gets."""
    sizes = (to_geometry.shape[1], to_rays.shape[1], to_geometry.shape[2])
    arrays = (chosen, ends, to_rays, to_geometry)
    return prepared(_gather_gradient, len(to_geometry), *sizes, *arrays, grain=GRAIN)


@jit
def _gather(start, stop, points, width, features, of_rays, geometry, chosen, ends, rows):  # type: ignore[no-untyped-def]
    """Writes the rows of rays start..stop. Those of a ray begin where those of the one before end."""
    m, d, g = U(points), U(width), U(features)
    for ray in range(start, stop):
        row = U(ends[ray - 1]) if ray else U(0)
        for i in range(U(ray) * m, (U(ray) + U(1)) * m):
            if chosen[i]:
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
