"""A proposal network on the CPU in one loop: hash grid, hidden layer and output, for the points inside a mask.

The plain reference is `ProposalNetwork.forward` times the mask. Here a block of points stays in the first-level cache
from its cells to its output, and points outside the mask cost nothing. There is no gradient: this is for evaluation
and for the four of five training steps in which the proposal networks do not learn.
"""

import numpy as np
from torch import Tensor

from qnerf.kernels.hashgrid import BLOCK, GRAIN, U, _corners, _flat
from qnerf.kernels.jit import jit, run


def propose(
    points: Tensor,
    mask: Tensor | None,
    table: Tensor,
    resolutions: Tensor,
    dense: bool,
    hidden: tuple[Tensor, Tensor],
    out: tuple[Tensor, Tensor],
) -> Tensor:
    """Raw outputs (N,) of the network, before trunc_exp; -inf outside the mask.

    Args:
        points: (N, 3) in the unit cube.
        mask: (n, n, n) bool over the unit cube, true where density may be; None for everywhere.
        table, resolutions, dense: of the hash grid, as `hash_encode` takes them.
        hidden, out: weight and bias of Linear(L F, H) and Linear(H, 1).
    """
    raw = points.new_empty(points.shape[0])
    grid = np.ones(1, np.bool_) if mask is None else _flat(mask)
    cells = 1 if mask is None else mask.shape[0]
    weights = (_flat(hidden[0]), _flat(hidden[1]), _flat(out[0]), _flat(out[1]))
    arrays = (_flat(points), grid, cells, _flat(table), _flat(resolutions), dense, table.shape[2], *weights, _flat(raw))
    run(_propose, len(points), *arrays, grain=GRAIN)
    return raw


@jit
def _propose(start, stop, points, grid, cells, table, resolutions, dense, features, w1, b1, w2, b2, out):  # type: ignore[no-untyped-def]
    """Writes the outputs of points start..stop."""
    number = points.dtype.type
    b = U(BLOCK)
    nf = U(features)
    width = resolutions.size * features
    inside = np.empty(3 * BLOCK, points.dtype)  # a block of points inside the mask, and their numbers
    number_of = np.empty(BLOCK, np.int64)
    row = np.empty(8 * BLOCK, np.uint32)
    weight = np.empty(8 * BLOCK, points.dtype)
    fraction = np.empty(3 * BLOCK, points.dtype)
    encoded = np.empty(width * BLOCK, points.dtype)
    unit = np.empty(BLOCK, points.dtype)
    total = np.empty(BLOCK, points.dtype)
    count = 0
    zero, n, last = number(0), number(cells), np.int64(cells - 1)
    for i in range(start, stop):
        x, y, z = points[3 * i], points[3 * i + 1], points[3 * i + 2]
        cx = min(max(np.int64(x * n), 0), last)
        cy = min(max(np.int64(y * n), 0), last)
        cz = min(max(np.int64(z * n), 0), last)
        if grid[(cx * cells + cy) * cells + cz]:
            inside[3 * count], inside[3 * count + 1], inside[3 * count + 2] = x, y, z
            number_of[count] = i
            count += 1
        else:
            out[i] = -np.inf
        if count == BLOCK or (i == stop - 1 and count > 0):
            _encode(inside, count, table, resolutions, dense, nf, row, weight, fraction, encoded)
            for k in range(U(count)):
                total[k] = b2[0]
            for h in range(U(b1.size)):
                bias = b1[h]
                for k in range(U(count)):
                    unit[k] = bias
                for f in range(U(width)):
                    w = w1[h * U(width) + f]
                    for k in range(U(count)):
                        unit[k] += w * encoded[f * b + k]
                w = w2[h]
                for k in range(U(count)):
                    total[k] += w * max(unit[k], zero)
            for k in range(count):
                out[number_of[k]] = total[k]
            count = 0


@jit
def _encode(points, count, table, resolutions, dense, nf, row, weight, fraction, encoded):  # type: ignore[no-untyped-def]
    """Features (L F, BLOCK) of the first `count` points, summed in the order of `hash_encode`."""
    levels = resolutions.size
    width = U(table.size // levels)
    size = table.size // levels // np.int64(nf)
    mask = np.uint32(size - 1)
    b = U(BLOCK)
    zero = points.dtype.type(0)
    for level in range(levels):
        direct = dense and (resolutions[level] + 1) ** 3 <= size
        _corners(points, 0, count, resolutions[level], direct, mask, row, weight, fraction)
        entry = table[U(level) * width : U(level + 1) * width]
        base = U(level) * nf * b
        if nf == U(2):
            for i in range(U(count)):
                even, odd = zero, zero
                for c in range(U(8)):
                    k, w = U(2) * U(row[c * b + i]), weight[c * b + i]
                    even += w * entry[k]
                    odd += w * entry[k + U(1)]
                encoded[base + i], encoded[base + b + i] = even, odd
        else:
            for f in range(nf):
                for i in range(U(count)):
                    encoded[base + f * b + i] = weight[i] * entry[nf * U(row[i]) + f]
                for c in range(U(1), U(8)):
                    for i in range(U(count)):
                        encoded[base + f * b + i] += weight[c * b + i] * entry[nf * U(row[c * b + i]) + f]
