"""Where the samples of rays lie in the unit cube: a compiled CPU loop and its plain PyTorch reference."""

import numpy as np
import torch
from torch import Tensor

from qnerf.kernels.hashgrid import U
from qnerf.kernels.jit import jit, run

GRAIN = 512  # rays that are worth waking a thread for
CUBE, BOX = 0, 1  # contractions that the loop knows


def places(
    origins: Tensor, directions: Tensor, edges: Tensor, contraction: int, half_extent: float, mask: Tensor | None
) -> tuple[Tensor, Tensor | None]:
    """The midpoints of intervals on R rays in the unit cube, (R, K, 3), and which are inside the mask, (R, K) bool.

    The points equal those of `Rays.along` and of the contraction to the last bit.

    Args:
        origins, directions: (R, 3), world units.
        edges: (R, K + 1) distances along the rays.
        contraction: CUBE: all of space by the largest coordinate; BOX: [-h, h]^3.
        half_extent: h of a box, world units.
        mask: (n, n, n) bool over the unit cube; None: everywhere, and nothing is told about the points.
    """
    rays, count = len(edges), edges.shape[1] - 1
    unit = edges.new_empty(rays, count, 3)
    inside = torch.empty(rays, 0 if mask is None else count, dtype=torch.bool)
    grid, cells = (inside, 0) if mask is None else (mask, mask.shape[0])
    space = (contraction, half_extent, grid, cells)
    run(place, rays, (origins, directions, edges, count), space, unit, inside, grain=GRAIN)
    return unit, None if mask is None else inside


@jit
def place(start, stop, rays, space, unit, inside):  # type: ignore[no-untyped-def]
    """Writes the points of rays start..stop."""
    origins, directions, edges, count = rays
    contraction, half_extent, grid, cells = space
    number = edges.dtype.type
    one, two, half, quarter = number(1), number(2), number(0.5), number(0.25)
    largest = number(np.finfo(edges.dtype).max / 4)
    span = number(2 * half_extent)
    n = U(count)
    x, y, z = np.empty(count, edges.dtype), np.empty(count, edges.dtype), np.empty(count, edges.dtype)
    last, side = np.int32(cells - 1), number(cells)
    for ray in range(U(start), U(stop)):
        r, e = U(3) * ray, ray * (n + U(1))
        ox, oy, oz = origins[r], origins[r + U(1)], origins[r + U(2)]
        dx, dy, dz = directions[r], directions[r + U(1)], directions[r + U(2)]
        # The midpoints of the ray's intervals, axis by axis: three plain arrays, which LLVM turns into vectors.
        for k in range(n):
            t = half * (edges[e + k + U(1)] + edges[e + k])
            x[k], y[k], z[k] = ox + dx * t, oy + dy * t, oz + dz * t
        # All of space into the cube by the largest coordinate (`contract`), or a box by its size. Each operation is the
        # reference's, in its order: the points equal its own to the last bit, and so do the cells that they choose.
        if contraction == CUBE:
            for k in range(n):
                px, py, pz = _bounded(x[k], largest), _bounded(y[k], largest), _bounded(z[k], largest)
                norm = max(max(abs(px), abs(py)), max(abs(pz), one))
                norm += number(0) * (px + py + pz)  # NaN stays
                rest = two - one / norm
                x[k] = (px / norm * rest + two) * quarter
                y[k] = (py / norm * rest + two) * quarter
                z[k] = (pz / norm * rest + two) * quarter
        else:
            for k in range(n):
                x[k], y[k], z[k] = x[k] / span + half, y[k] / span + half, z[k] / span + half
        first = ray * n
        for k in range(n):
            p = U(3) * (first + k)
            unit[p], unit[p + U(1)], unit[p + U(2)] = x[k], y[k], z[k]
        # The cell of the mask; outside the cube the nearest one.
        if inside.size:
            for k in range(n):
                cx, cy, cz = _cell(x[k] * side, last), _cell(y[k] * side, last), _cell(z[k] * side, last)
                inside[first + k] = grid[U((cx * cells + cy) * cells + cz)]


@jit
def _cell(place, last):  # type: ignore[no-untyped-def]
    """The nearest cell from 0 to `last`; 0 for NaN."""
    if place >= last:
        return last
    return np.int32(place if place > 0 else 0)


@jit
def _bounded(value, largest):  # type: ignore[no-untyped-def]
    """`value` between -largest and largest; NaN stays."""
    if value > largest:
        return largest
    if value < -largest:
        return -largest
    return value
