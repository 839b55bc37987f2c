"""Multiresolution hash encoding (Sec. 3, arXiv:2201.05989): a compiled CPU loop and its plain PyTorch reference.

Level l has a grid of `resolutions[l]` cells along each side of the unit cube, with vertices at k / resolution,
k = 0..resolution. A point's features at that level are interpolated trilinearly from the 8 vertices of its cell. The
features of vertex (i, j, k) are in row

    i + j s + k s^2, s = resolution + 1                      where the whole grid fits into the table (`dense`)
    (i xor j * 2654435761 xor k * 805459861) mod T           elsewhere (Eq. 4, arXiv:2201.05989)

The position of a point in its cell is computed in float64, or as if it were. At 2,048 cells a float32 product alone
would be off by 1e-4 of a cell and would pick the wrong cell near a border. In this way float32 features and gradients
are exact to a few roundings at any resolution.

Points outside [0, 1] are moved to the nearest face, and their gradient across it is 0. A point on a border belongs to
the cell above it, at 1 to the last cell. A NaN coordinate gives NaN features.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numba import extending, types
from torch import Tensor

from qnerf.kernels.derivatives import clamped
from qnerf.kernels.dispatch import is_transformed
from qnerf.kernels.jit import flat, jit, run
from qnerf.kernels.loop import Loop
from qnerf.kernels.simd import (
    VECTOR_BYTES,
    fused,
    gather,
    gather_pairs,
    join,
    load,
    load_pair,
    load_twice,
    pair,
    store,
    store_split,
)

PRIMES = (1, 2654435761, 805459861)
CORNERS = [(c & 1, (c >> 1) & 1, c >> 2) for c in range(8)]
FINEST = 2**20  # cells along a side: beyond, float32 coordinates cannot tell cells apart
BLOCK = 128  # points at a time: their corner rows and weights stay in the first-level cache
GRAIN = 1024  # points that are worth waking a thread for
ALL_POINTS = (
    np.empty((0, BLOCK), np.int32),
    np.empty(0, np.int32),
)  # gradients of all points in turn: none were chosen


def hash_encode(points: Tensor, table: Tensor, resolutions: Tensor, dense: bool = True) -> Tensor:
    """Features (N, L F) of points, level by level.

    On the CPU this is a compiled loop. Its values and its gradients (of points and table) equal those of
    `hash_encode_reference` to rounding, and they do not depend on the number of threads. Second derivatives, and
    everything on other devices, come from the reference.

    >>> table = torch.ones(2, 2**4, 1)
    >>> hash_encode(torch.rand(5, 3), table, torch.tensor([2, 8])).shape
    torch.Size([5, 2])

    Args:
        points: (N, 3) in the unit cube.
        table: (L, T, F); T is a power of two.
        resolutions: (L,) int64, cells along a side, 1 to 2^20.
        dense: index grids that fit into the table without hashing.

    Raises:
        ValueError: shapes, dtypes or resolutions do not fit.
    """
    check(points, table, resolutions)
    encoded: Tensor = _ENCODE(points, table, resolutions, dense)
    return encoded


def hash_encode_reference(points: Tensor, table: Tensor, resolutions: Tensor, dense: bool = True) -> Tensor:
    """What `hash_encode` computes, in plain PyTorch: any device, any dtype, differentiable any number of times."""
    check(points, table, resolutions)
    levels, size, _ = table.shape
    resolution = resolutions.to(points.device)[:, None, None]  # (L, 1, 1)
    scaled = clamped(points, 0.0, 1.0).double() * resolution  # (L, N, 3), exact where points are float32
    cell = torch.minimum(scaled.detach().nan_to_num(nan=0.0).long(), resolution - 1)
    high = (scaled - cell).to(points.dtype)
    low = 1 - high
    side = resolution[..., 0] + 1  # (L, 1)
    direct = torch.full_like(side, dense, dtype=torch.bool) & (side**3 <= size)
    level = torch.arange(levels, device=points.device)[:, None]
    features = None
    for corner in CORNERS:
        weight_x, weight_y, weight_z = (high[..., a] if bit else low[..., a] for a, bit in enumerate(corner))
        x, y, z = (cell[..., a] + bit for a, bit in enumerate(corner))
        hashed = (x ^ (y * PRIMES[1]) ^ (z * PRIMES[2])) & (size - 1)
        row = torch.where(direct, x + y * side + z * side * side, hashed)
        term = (weight_x * (weight_y * weight_z))[..., None] * table[level, row]  # (L, N, F)
        features = term if features is None else features + term
    assert features is not None
    return features.transpose(0, 1).flatten(1)


def check(points: Tensor, table: Tensor, resolutions: Tensor) -> None:
    """ValueError unless these are arguments of `hash_encode`."""
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"hash grid: points must be (N, 3), got {tuple(points.shape)}")
    if table.ndim != 3 or table.shape[1] & (table.shape[1] - 1) or not 1 < table.shape[1] <= 2**31 or not table.numel():
        raise ValueError(f"hash grid: table must be (L, T, F) with T a power of two from 2, got {tuple(table.shape)}")
    if resolutions.shape != table.shape[:1] or resolutions.dtype != torch.int64:
        raise ValueError(
            f"hash grid: resolutions must be int64 ({table.shape[0]},), "
            f"got {resolutions.dtype} {tuple(resolutions.shape)}"
        )
    if points.dtype != table.dtype or not points.is_floating_point():
        raise ValueError(f"hash grid: points and table must share a dtype, got {points.dtype} and {table.dtype}")
    if points.device.type == "cpu" and not is_transformed(points):
        cells = resolutions.numpy()
        if cells.min() < 1 or cells.max() > FINEST:
            raise ValueError(f"hash grid: resolutions must be 1 to {FINEST}, got {cells.tolist()}")


def _encode(keeps: bool, points: Tensor, table: Tensor, resolutions: Tensor, dense: bool) -> tuple[Tensor, tuple[()]]:
    levels, _, features = table.shape
    out = points.new_empty(points.shape[0], levels * features)
    run(_forward, len(points), points, table, resolutions, dense, features, out, grain=GRAIN)
    return out, ()


def _encode_gradient(
    needs: Sequence[bool], inputs: Sequence[Any], kept: Sequence[Any], gradient: Tensor
) -> tuple[Tensor | None, Tensor | None]:
    points, table, resolutions, dense = inputs
    levels, _, features = table.shape
    common = (gradient, resolutions, dense, features)
    to_points = to_table = None
    if needs[1]:
        to_table = empty_like(table)  # each level is zeroed by the thread that owns it
        run(table_gradient, levels, points, *ALL_POINTS, *common, to_table, grain=1)
    if needs[0]:
        to_points = torch.empty(points.shape, dtype=points.dtype)
        run(_points_gradient, len(points), points, *common, table, to_points, grain=GRAIN)
    return to_points, to_table


_ENCODE = Loop("hash grid", hash_encode_reference, _encode, _encode_gradient)


def empty_like(tensor: Tensor) -> Tensor:
    """A tensor with arbitrary contents. NumPy asks for huge pages, where PyTorch does not: large ones cost less."""
    return torch.from_numpy(np.empty(tuple(tensor.shape), flat(tensor).dtype))


# The loops below index flat arrays with unsigned integers: Numba tests every signed index for wrap-around.
U = np.uintp


@jit
def _cell(x, cells, last):  # type: ignore[no-untyped-def]
    """The cell of a coordinate, as uint32, and the position in it, from 0 to 1."""
    number = type(x)
    zero, one = number(0), number(1)
    # Both comparisons are false for NaN, so that it stays; its cell is that of 0, because a NaN has no integer.
    inside = zero if x < zero else (one if x > one else x)
    place = inside * cells
    cell = min(np.int32(place if place >= zero else zero), last)
    position = position_in_cell(inside, cells, cell)
    # The product of float32 may have been rounded up to the next cell.
    below = np.int32(cell - np.int32(1))
    return (
        np.uint32(below if position < zero else cell),
        position_in_cell(inside, cells, below) if position < zero else position,
    )


def position_in_cell(x: Any, cells: Any, cell: Any) -> Any:
    """x cells - cell in compiled code: of float32 as if computed in float64."""


@extending.overload(position_in_cell)
def _position_in_cell(x, cells, cell):  # type: ignore[no-untyped-def]
    if x == types.float32:
        return lambda x, cells, cell: fused(x, cells, -np.float32(cell))
    return lambda x, cells, cell: x * cells - cell


@jit
def corners(points, first, count, resolution, direct, mask, row, weight, fraction):  # type: ignore[no-untyped-def]
    """For points first..first + count: rows and weights of the 8 corners (8, BLOCK), and `fraction` (3, BLOCK).

    `fraction` is the position in the cell along each axis, in [0, 1]. Each product and sum of rows is cut to 32 bits at
    once, because Numba's are 64 bits wide, of which a vector holds half as many.
    """
    u32 = np.uint32
    number = points.dtype.type
    one, cells, last = number(1), number(resolution), np.int32(resolution - 1)
    side = u32(resolution + 1)
    plane = u32(side * side)
    prime_y, prime_z, u1 = u32(2654435761), u32(805459861), u32(1)
    b = U(BLOCK)
    # The cell of each point, and from it the rows of its 8 corners. Corner c is at x + (c & 1), y + (c >> 1 & 1), z +
    # (c >> 2), so rows and weights of corner c start at c BLOCK. A direct row is one sum, and a neighbour's row is a
    # constant further on.
    if direct:
        for i in range(U(count)):
            j = U(3) * (U(first) + i)
            x, fraction[i] = _cell(points[j], cells, last)
            y, fraction[b + i] = _cell(points[j + U(1)], cells, last)
            z, fraction[U(2) * b + i] = _cell(points[j + U(2)], cells, last)
            low = u32(u32(x + u32(y * side)) + u32(z * plane))
            high = u32(low + plane)
            row[i], row[b + i] = low, u32(low + u1)
            row[U(2) * b + i], row[U(3) * b + i] = u32(low + side), u32(u32(low + side) + u1)
            row[U(4) * b + i], row[U(5) * b + i] = high, u32(high + u1)
            row[U(6) * b + i], row[U(7) * b + i] = u32(high + side), u32(u32(high + side) + u1)
    # A hashed row is the exclusive or of one number for each axis. Both numbers of an axis are computed once, and those
    # of y and z are joined once for each of their four pairs. The table's size is a power of two: `mask` is the
    # modulus.
    else:
        for i in range(U(count)):
            j = U(3) * (U(first) + i)
            x, fraction[i] = _cell(points[j], cells, last)
            y, fraction[b + i] = _cell(points[j + U(1)], cells, last)
            z, fraction[U(2) * b + i] = _cell(points[j + U(2)], cells, last)
            x0, x1 = u32(x & mask), u32(u32(x + u1) & mask)
            y0, z0 = u32(y * prime_y), u32(z * prime_z)
            y1, z1 = u32(y0 + prime_y), u32(z0 + prime_z)
            yz00, yz10 = u32(u32(y0 ^ z0) & mask), u32(u32(y1 ^ z0) & mask)
            yz01, yz11 = u32(u32(y0 ^ z1) & mask), u32(u32(y1 ^ z1) & mask)
            row[i], row[b + i] = u32(x0 ^ yz00), u32(x1 ^ yz00)
            row[U(2) * b + i], row[U(3) * b + i] = u32(x0 ^ yz10), u32(x1 ^ yz10)
            row[U(4) * b + i], row[U(5) * b + i] = u32(x0 ^ yz01), u32(x1 ^ yz01)
            row[U(6) * b + i], row[U(7) * b + i] = u32(x0 ^ yz11), u32(x1 ^ yz11)
    # Trilinear weights: f is the distance from the lower corner along an axis, g = 1 - f. A loop of its
    # own, of plain arithmetic on consecutive floats, which LLVM turns into vectors.
    for i in range(U(count)):
        fx, fy, fz = fraction[i], fraction[b + i], fraction[U(2) * b + i]
        gx, gy, gz = one - fx, one - fy, one - fz
        w00, w10, w01, w11 = gy * gz, fy * gz, gy * fz, fy * fz
        weight[i], weight[b + i] = gx * w00, fx * w00
        weight[U(2) * b + i], weight[U(3) * b + i] = gx * w10, fx * w10
        weight[U(4) * b + i], weight[U(5) * b + i] = gx * w01, fx * w01
        weight[U(6) * b + i], weight[U(7) * b + i] = gx * w11, fx * w11


@jit
def interpolate(points, count, table, resolutions, dense, features, row, weight, fraction, encoded):  # type: ignore[no-untyped-def]
    """Writes the features (L F, BLOCK) of the first `count` points.

    `row` is valid throughout, also before the first call: whole vectors of rows are read.
    """
    levels = resolutions.size
    width = U(table.size // levels)
    nf = U(features)
    size = table.size // (levels * features)
    mask = np.uint32(size - 1)
    b, lanes = U(BLOCK), U(VECTOR_BYTES // points.itemsize)
    for level in range(levels):
        direct = dense and (resolutions[level] + 1) ** 3 <= size
        corners(points, 0, count, resolutions[level], direct, mask, row, weight, fraction)
        entry = table[U(level) * width : U(level + 1) * width]
        base = U(level) * nf * b
        # One feature: a vector of points at a time. Each corner's entries are gathered and added with their weights.
        if nf == U(1):
            for i in range(U(0), U(count), lanes):
                total = load(weight, i) * gather(entry, row, i)
                for c in range(b, U(8) * b, b):
                    total = total + load(weight, c + i) * gather(entry, row, c + i)
                store(encoded, base + i, total)
        # Two features lie side by side: half as many points fill a vector, and one gather brings both numbers of each.
        # The result alternates, and is split into one row for each feature.
        elif nf == U(2):
            for i in range(U(0), U(count), lanes // U(2)):
                total = load_twice(weight, i) * gather_pairs(entry, row, i)
                for c in range(b, U(8) * b, b):
                    total = total + load_twice(weight, c + i) * gather_pairs(entry, row, c + i)
                store_split(encoded, base + i, base + b + i, total)
        # Any other number: one feature after another.
        else:
            for f in range(nf):
                for i in range(U(count)):
                    encoded[base + f * b + i] = weight[i] * entry[nf * U(row[i]) + f]
                for c in range(U(1), U(8)):
                    for i in range(U(count)):
                        encoded[base + f * b + i] += weight[c * b + i] * entry[nf * U(row[c * b + i]) + f]


@jit
def _forward(start, stop, points, table, resolutions, dense, features, out):  # type: ignore[no-untyped-def]
    """Writes the features of points start..stop."""
    width = U(resolutions.size * features)
    row = np.zeros(8 * BLOCK, np.uint32)
    weight, fraction = np.zeros(8 * BLOCK, points.dtype), np.empty(3 * BLOCK, points.dtype)
    encoded = np.empty(width * U(BLOCK), points.dtype)
    # A block of points goes through all levels while its rows and weights are in the first-level cache.
    for first in range(start, stop, BLOCK):
        count = U(min(BLOCK, stop - first))
        block = points[U(3) * U(first) : U(3) * (U(first) + count)]
        interpolate(block, count, table, resolutions, dense, features, row, weight, fraction, encoded)
        for i in range(count):
            for f in range(width):
                out[(U(first) + i) * width + f] = encoded[f * U(BLOCK) + i]


@jit
def add_gradient(entry, gradient, base, point, feature, count, features, row, weight):  # type: ignore[no-untyped-def]
    """Adds the gradients of a block of points to one level's `entry`.

    The gradient of feature f of point i is gradient[base + i * point + f * feature].
    """
    b = U(BLOCK)
    # An entry's gradient is the sum over points and corners of the trilinear weight times the feature's gradient.
    # Points share entries, so they are added one after another: in the same order for any number of threads.
    if features == U(1):
        for i in range(U(count)):
            g = gradient[base + i * point]
            for c in range(U(8)):
                entry[row[c * b + i]] += weight[c * b + i] * g
    elif features == U(2):
        for i in range(U(count)):
            both = join(gradient[base + i * point], gradient[base + i * point + feature])
            for c in range(U(8)):
                k = U(2) * U(row[c * b + i])
                store(entry, k, load_pair(entry, k) + pair(weight[c * b + i]) * both)
    else:
        for i in range(U(count)):
            for c in range(U(8)):
                k, w = features * U(row[c * b + i]), weight[c * b + i]
                for f in range(features):
                    entry[k + f] += w * gradient[base + i * point + f * feature]


@jit
def table_gradient(start, stop, points, number_of, kept, gradient, resolutions, dense, features, out):  # type: ignore[no-untyped-def]
    """Writes the table's gradient of levels start..stop; adds the points in their order.

    `gradient` is flat: of all points in turn (N, L F) or, of the points `number_of` that were `kept` in each block of
    points, (blocks, L F, BLOCK).
    """
    levels, b, nf = resolutions.size, U(BLOCK), U(features)
    width, stride, points_in_all = U(out.size // levels), U(levels * features), U(points.size // 3)
    size = out.size // (levels * features)
    mask = np.uint32(size - 1)
    local = np.empty(3 * BLOCK, points.dtype)
    row = np.empty(8 * BLOCK, np.uint32)
    weight, fraction = np.empty(8 * BLOCK, points.dtype), np.empty(3 * BLOCK, points.dtype)
    chosen = kept.size > 0
    point, feature = (U(1), b) if chosen else (stride, U(1))
    # A thread owns whole levels. So no two threads write to one entry, and nothing has to be merged.
    for level in range(start, stop):
        entry = out[U(level) * width : U(level + 1) * width]
        entry[:] = 0
        direct = dense and (resolutions[level] + 1) ** 3 <= size
        for first in range(U(0), U(kept.size) * b if chosen else points_in_all, b):
            count = min(b, points_in_all - first)
            if chosen:
                numbers, count = number_of[first // b], U(kept[first // b])
                for k in range(count):
                    i, j = U(3) * U(numbers[k]), U(3) * k
                    local[j], local[j + U(1)], local[j + U(2)] = points[i], points[i + U(1)], points[i + U(2)]
                corners(local, U(0), count, resolutions[level], direct, mask, row, weight, fraction)
            else:
                corners(points, first, count, resolutions[level], direct, mask, row, weight, fraction)
            base = first * stride + U(level) * nf * feature
            add_gradient(entry, gradient, base, point, feature, count, nf, row, weight)


@jit
def _points_gradient(start, stop, points, gradient, resolutions, dense, features, table, out):  # type: ignore[no-untyped-def]
    """Writes the gradient of points start..stop."""
    levels = resolutions.size
    width = U(table.size // levels)
    size = table.size // (levels * features)
    mask = np.uint32(size - 1)
    stride = U(levels * features)
    b, nf = U(BLOCK), U(features)
    row = np.empty(8 * BLOCK, np.uint32)
    weight = np.empty(8 * BLOCK, points.dtype)
    fraction = np.empty(3 * BLOCK, points.dtype)
    dot = np.empty(8 * BLOCK, points.dtype)  # gradient times features at each corner
    total = np.empty(3 * BLOCK, points.dtype)
    number = points.dtype.type
    zero, one = number(0), number(1)
    for first in range(start, stop, BLOCK):
        count = min(BLOCK, stop - first)
        total[:] = 0
        for level in range(levels):
            direct = dense and (resolutions[level] + 1) ** 3 <= size
            cells = number(resolutions[level])
            corners(points, first, count, resolutions[level], direct, mask, row, weight, fraction)
            entry = table[U(level) * width : U(level + 1) * width]
            base = U(first) * stride + U(level) * nf
            # What moving the point's weight to each corner would be worth: the gradient times the corner's features.
            for c in range(U(0), U(8) * b, b):
                if features == 1:
                    for i in range(U(count)):
                        dot[c + i] = gradient[base + i * stride] * entry[row[c + i]]
                elif features == 2:
                    for i in range(U(count)):
                        j, k = base + i * stride, U(2) * U(row[c + i])
                        dot[c + i] = gradient[j] * entry[k] + gradient[j + U(1)] * entry[k + U(1)]
                else:
                    for i in range(U(count)):
                        k, product = nf * U(row[c + i]), zero
                        for f in range(nf):
                            product += gradient[base + i * stride + f] * entry[k + f]
                        dot[c + i] = product
            # Along an axis the derivative is the difference of opposite corners, interpolated along the other two axes,
            # times the cells along a side.
            for i in range(U(count)):
                fx, fy, fz = fraction[i], fraction[b + i], fraction[U(2) * b + i]
                gx, gy, gz = one - fx, one - fy, one - fz
                d0, d1, d2, d3 = dot[i], dot[b + i], dot[U(2) * b + i], dot[U(3) * b + i]
                d4, d5, d6, d7 = dot[U(4) * b + i], dot[U(5) * b + i], dot[U(6) * b + i], dot[U(7) * b + i]
                along_x = gz * (gy * (d1 - d0) + fy * (d3 - d2)) + fz * (gy * (d5 - d4) + fy * (d7 - d6))
                along_y = gz * (gx * (d2 - d0) + fx * (d3 - d1)) + fz * (gx * (d6 - d4) + fx * (d7 - d5))
                along_z = gy * (gx * (d4 - d0) + fx * (d5 - d1)) + fy * (gx * (d6 - d2) + fx * (d7 - d3))
                total[i] += cells * along_x
                total[b + i] += cells * along_y
                total[U(2) * b + i] += cells * along_z
        # A point outside was moved to the nearest face: across it the features do not change.
        for i in range(U(count)):
            for axis in range(U(3)):
                j = U(3) * (U(first) + i) + axis
                inside = points[j] >= zero and points[j] <= one
                out[j] = total[axis * b + i] if inside else zero
