"""A hash grid and an MLP of two layers on its features, in one loop each way, and their plain PyTorch reference.

This is a proposal network, and the density of a classical field. A block of points stays in the first-level cache from
its cells to the outputs. Points that are not `inside` cost nothing.

The backward pass keeps the features, computes the hidden layer again, and sums the gradients of the weights over parts
of `PART` blocks, and then over the parts: they do not depend on the number of threads.
"""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from qnerf.kernels.derivatives import is_differentiated, through_reference
from qnerf.kernels.dispatch import serves
from qnerf.kernels.hashgrid import (
    BLOCK,
    U,
    add_gradient,
    check,
    corners,
    empty,
    flat,
    hash_encode_reference,
    interpolate,
)
from qnerf.kernels.jit import jit, run
from qnerf.kernels.simd import VECTOR_BYTES, inner, load, splat, store, where_positive

PART = 8  # blocks that one thread takes at a time
GROUP = 4  # hidden units that the inner loops take at once


class Grid(NamedTuple):
    """What `hash_encode` takes besides the points."""

    table: Tensor  # (L, T, F)
    resolutions: Tensor  # (L,) int64
    dense: bool


class Layer(NamedTuple):
    weight: Tensor  # (outputs, inputs)
    bias: Tensor  # (outputs,)


def grid_mlp(points: Tensor, inside: Tensor | None, grid: Grid, hidden: Layer, out: Layer) -> Tensor:
    """Values (N, O) of Linear(ReLU(Linear(features))) at the points.

    The gradients of table, weights and biases equal those of `grid_mlp_reference` to rounding. The points get none.

    Args:
        points: (N, 3) in the unit cube.
        inside: (N,) bool, the points to evaluate; the others have the values -inf, 0, 0, ..., which make no density.
            None: all.
        grid: a hash grid of L levels with F features each.
        hidden: weight (H, L F) and bias (H,).
        out: weight (O, H) and bias (O,).

    Raises:
        ValueError: the points need a gradient, or a shape or dtype is not as above.
    """
    if points.requires_grad:
        raise ValueError("grid_mlp: points without gradient expected; hash_encode and linear layers give them one")
    check(points, grid.table, grid.resolutions)
    levels, _, features = grid.table.shape
    shapes = [tuple(tensor.shape) for tensor in (*hidden, *out)]
    units, outputs = hidden.weight.shape[0], out.weight.shape[0]
    if shapes != [(units, levels * features), (units,), (outputs, units), (outputs,)]:
        raise ValueError(f"grid_mlp: layers on {levels * features} features expected, got the shapes {shapes}")
    if inside is not None and (inside.shape != points.shape[:1] or inside.dtype != torch.bool):
        raise ValueError(f"grid_mlp: inside must be bool ({len(points)},), got {inside.dtype} {tuple(inside.shape)}")
    if serves("hash grid + MLP", points, grid.table, *hidden, *out):
        parameters = (grid.table, *hidden, *out)
        keeps = torch.is_grad_enabled() and any(parameter.requires_grad for parameter in parameters)
        values: Tensor = _GridMLP.apply(keeps, points, inside, grid.resolutions, grid.dense, *parameters)
        return values
    return grid_mlp_reference(points, inside, grid, hidden, out)


def grid_mlp_reference(points: Tensor, inside: Tensor | None, grid: Grid, hidden: Layer, out: Layer) -> Tensor:
    """`grid_mlp` in plain PyTorch: any device, any dtype, differentiable any number of times."""
    units = torch.nn.functional.linear(hash_encode_reference(points, *grid), *hidden).relu()
    values = torch.nn.functional.linear(units, *out)
    if inside is None:
        return values
    return torch.where(inside[:, None], values, _outside(values))


def _outside(values: Tensor) -> Tensor:
    """The values (O,) of a point that is not evaluated."""
    row = values.new_zeros(values.shape[1])
    row[0] = -torch.inf
    return row


class _GridMLP(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        keeps: bool,
        points: Tensor,
        inside: Tensor | None,
        resolutions: Tensor,
        dense: bool,
        table: Tensor,
        w1: Tensor,
        b1: Tensor,
        w2: Tensor,
        b2: Tensor,
    ) -> Tensor:
        count, features = len(points), table.shape[2]
        blocks = -(-count // BLOCK)
        dtype = flat(points).dtype
        width = w1.shape[1]
        where = np.ones(0, np.bool_) if inside is None else flat(inside)
        encoded = empty((blocks if keeps else 0, width * BLOCK), dtype)
        number_of = np.empty((blocks if keeps else 0, BLOCK), np.int32)
        kept = np.empty(blocks, np.int32)
        values = points.new_empty(count, w2.shape[0])
        grid = (flat(table), flat(resolutions), dense, features)
        layers = packed(w1, b1, w2, b2)
        arrays = (flat(points), where, *grid, *layers, keeps, encoded.numpy(), number_of, kept, flat(values))
        run(network_values, blocks, *arrays, grain=PART)
        if keeps:
            ctx.save_for_backward(points, inside, resolutions, table, w1, b1, w2, b2, encoded)
            ctx.dense, ctx.number_of, ctx.kept = dense, number_of, kept
        return values

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        points, inside, resolutions, table, w1, b1, w2, b2, encoded = ctx.saved_tensors
        if is_differentiated(upstream):

            def reference(table: Tensor, w1: Tensor, b1: Tensor, w2: Tensor, b2: Tensor) -> Tensor:
                grid = Grid(table, resolutions, ctx.dense)
                return grid_mlp_reference(points, inside, grid, Layer(w1, b1), Layer(w2, b2))

            return *[None] * 5, *through_reference(reference, (table, w1, b1, w2, b2), upstream)
        parts, dtype = -(-len(ctx.kept) // PART), flat(points).dtype
        layers = packed(w1, b1, w2, b2)
        rows, outputs = layers[1].size, w2.shape[0]
        width = layers[0].size // rows
        to_encoded = empty(tuple(encoded.shape), dtype)
        sums = np.empty((parts, rows * (width + 1 + outputs) + outputs), dtype)
        common = (ctx.number_of, ctx.kept)
        arrays = (encoded.numpy(), *layers, *common, flat(upstream), to_encoded.numpy(), sums)
        run(_backward, parts, *arrays, grain=1)
        to_table = empty(tuple(table.shape), dtype)
        arrays = (flat(points), *common, to_encoded.numpy(), flat(resolutions), ctx.dense, table.shape[2])
        run(_table_gradient, len(table), *arrays, flat(to_table), grain=1)
        total = torch.from_numpy(sums.sum(0))
        to_w1, to_b1, to_w2, to_b2 = total.split([rows * width, rows, outputs * rows, outputs])
        units = len(b1)
        to_w1, to_w2 = to_w1.view(rows, width)[:units], to_w2.view(outputs, rows)[:, :units]
        return *[None] * 5, to_table, to_w1, to_b1[:units], to_w2.contiguous(), to_b2


def _padded(count: int) -> int:
    return -(-count // GROUP) * GROUP


def packed(w1: Tensor, b1: Tensor, w2: Tensor, b2: Tensor) -> tuple[np.ndarray, ...]:
    """The layers, with hidden units filled up with zeros to whole groups."""
    units, rows = len(b1), _padded(len(b1))
    if units != rows:
        pad = torch.nn.functional.pad
        w1, b1, w2 = pad(w1, (0, 0, 0, rows - units)), pad(b1, (0, rows - units)), pad(w2, (0, rows - units))
    return flat(w1), flat(b1), flat(w2), flat(b2)


@inner
def _hidden(k, lanes, encoded, w1, b1, h, width, unit):  # type: ignore[no-untyped-def]
    """Writes GROUP hidden units from h, before ReLU, of 2 `lanes` points from k: unit (GROUP, 2 lanes).

    `encoded` (width, BLOCK) and `w1` (H, width) are flat, as everywhere below.
    """
    # Four units times two vectors of points are eight sums in registers: each feature is loaded once for four units,
    # and each weight once for two vectors. Eight independent sums hide the latency of a multiplication with addition.
    a, b, c, d = splat(b1[h]), splat(b1[h + U(1)]), splat(b1[h + U(2)]), splat(b1[h + U(3)])
    a2, b2, c2, d2 = a, b, c, d
    for f in range(width):
        e, e2, w = load(encoded, f * U(BLOCK) + k), load(encoded, f * U(BLOCK) + k + lanes), h * width + f
        wa, wb = splat(w1[w]), splat(w1[w + width])
        wc, wd = splat(w1[w + U(2) * width]), splat(w1[w + U(3) * width])
        a, a2 = a + wa * e, a2 + wa * e2
        b, b2 = b + wb * e, b2 + wb * e2
        c, c2 = c + wc * e, c2 + wc * e2
        d, d2 = d + wd * e, d2 + wd * e2
    store(unit, U(0), a)
    store(unit, lanes, a2)
    store(unit, U(2) * lanes, b)
    store(unit, U(3) * lanes, b2)
    store(unit, U(4) * lanes, c)
    store(unit, U(5) * lanes, c2)
    store(unit, U(6) * lanes, d)
    store(unit, U(7) * lanes, d2)


@inner
def _values(count, lanes, encoded, w1, b1, w2, b2, width, unit, total):  # type: ignore[no-untyped-def]
    """Writes the values (O, BLOCK) of a block of points; `unit` (H, 2 lanes) is used on the way."""
    rows, pair = U(b1.size), U(2) * lanes
    zero = splat(encoded.dtype.type(0))
    # Two vectors of points at a time go through the whole MLP: their hidden units stay in the first-level cache.
    for k in range(U(0), U(count), pair):
        for h in range(U(0), rows, U(GROUP)):
            _hidden(k, lanes, encoded, w1, b1, h, width, unit[h * pair :])
        for u in range(U(0), rows * pair, lanes):
            x = load(unit, u)
            store(unit, u, where_positive(x, x))
        # Even and odd hidden units are summed apart, so that one addition need not wait for the one before.
        for o in range(U(b2.size)):
            even, even2, odd, odd2 = splat(b2[o]), splat(b2[o]), zero, zero
            for h in range(U(0), rows, U(2)):
                this, other = splat(w2[o * rows + h]), splat(w2[o * rows + h + U(1)])
                even = even + this * load(unit, h * pair)
                even2 = even2 + this * load(unit, h * pair + lanes)
                odd = odd + other * load(unit, (h + U(1)) * pair)
                odd2 = odd2 + other * load(unit, (h + U(1)) * pair + lanes)
            store(total, o * U(BLOCK) + k, even + odd)
            store(total, o * U(BLOCK) + k + lanes, even2 + odd2)


@inner
def _gather(points, inside, first, last, numbers, local):  # type: ignore[no-untyped-def]
    """Copies the points first..last that are inside to `local` (count, 3), their numbers to `numbers`; their count."""
    # Without a branch: every number is written, and the next one overwrites it unless its point is inside.
    count = U(0)
    for i in range(U(first), U(last)):
        numbers[count] = i
        count += U(inside[i])
    for k in range(count):
        i, j = U(3) * U(numbers[k]), U(3) * k
        local[j], local[j + U(1)], local[j + U(2)] = points[i], points[i + U(1)], points[i + U(2)]
    return count


@jit
def network_values(  # type: ignore[no-untyped-def]
    start, stop, points, inside, table, resolutions, dense, features, w1, b1, w2, b2, keeps, kept_features, number_of,
    kept, values,
):  # fmt: skip
    """Writes the values of blocks start..stop and, if `keeps`, the features and numbers of the points inside."""
    zero = points.dtype.type(0)
    lanes = U(VECTOR_BYTES // points.itemsize)
    width, outputs, b = w1.size // b1.size, U(b2.size), U(BLOCK)
    local = np.empty(3 * BLOCK, points.dtype)
    numbers = np.empty(BLOCK + 1, np.int32)
    row = np.zeros(8 * BLOCK, np.uint32)
    weight = np.zeros(8 * BLOCK, points.dtype)
    fraction = np.empty(3 * BLOCK, points.dtype)
    encoded = np.zeros(width * BLOCK, points.dtype)
    unit = np.empty(2 * b1.size * lanes, points.dtype)
    total = np.empty(b2.size * BLOCK, points.dtype)
    for block in range(start, stop):
        first = block * BLOCK
        last = min(first + BLOCK, points.size // 3)
        # The features of the block's points. With a mask, those inside are packed together first, and the others get
        # the values of no density.
        if inside.size == 0:
            count = U(last - first)
            for k in range(count):
                numbers[k] = U(first) + k
            interpolate(
                points[3 * first : 3 * last], count, table, resolutions, dense, features, row, weight, fraction, encoded
            )
        else:
            count = _gather(points, inside, first, last, numbers, local)
            interpolate(local, count, table, resolutions, dense, features, row, weight, fraction, encoded)
            for i in range(U(first) * outputs, U(last) * outputs):
                values[i] = zero
            for i in range(U(first) * outputs, U(last) * outputs, outputs):
                values[i] = -np.inf
        _values(count, lanes, encoded, w1, b1, w2, b2, U(width), unit, total)
        for o in range(outputs):
            for k in range(count):
                values[U(numbers[k]) * outputs + o] = total[o * b + k]
        # What the backward pass needs. Places behind the last point are cleared, because it works on whole vectors.
        if keeps:
            for f in range(U(width)):
                for k in range(count, b):
                    encoded[f * b + k] = zero
            # Loops: for an assignment of arrays Numba would also compile the message of a wrong shape, which takes 2 s.
            for i in range(encoded.size):
                kept_features[block, i] = encoded[i]
            for k in range(b):
                number_of[block, k] = numbers[k]
            kept[block] = count


@jit
def _backward(  # type: ignore[no-untyped-def]
    start, stop, kept_features, w1, b1, w2, b2, number_of, kept, upstream, to_features, sums
):
    """Writes the gradients of the features of parts start..stop, and the sums of those of weights and biases.

    `sums` (parts, all) are in the order w1, b1, w2, b2, and still to be added over parts.
    """
    dtype = kept_features.dtype
    lanes = U(VECTOR_BYTES // kept_features.itemsize)
    rows, outputs = U(b1.size), U(b2.size)
    width, b = U(w1.size // b1.size), U(BLOCK)
    unit = np.empty(GROUP * BLOCK, dtype)
    two = np.empty(2 * GROUP * BLOCK, dtype)
    slope = np.empty(GROUP * BLOCK, dtype)
    above = np.empty(b2.size * BLOCK, dtype)  # gradients of the values, one output after another
    first_b1, first_w2 = rows * width, rows * (width + U(1))
    first_b2 = first_w2 + outputs * rows
    out = np.empty(sums.shape[1] * VECTOR_BYTES // kept_features.itemsize, dtype)  # vectors, still to be summed
    zero = splat(dtype.type(0))
    for part in range(start, stop):
        out[:] = 0
        for block in range(part * PART, min((part + 1) * PART, kept.size)):
            # The gradients of the block's values, one output after another, for the points that were evaluated.
            encoded, gradient, numbers, end = kept_features[block], to_features[block], number_of[block], U(kept[block])
            gradient[:] = 0
            above[:] = 0
            for o in range(outputs):
                for k in range(end):
                    above[o * b + k] = upstream[U(numbers[k]) * outputs + o]
            # Biases of the last layer: the sums of these gradients. As everywhere below, a sum stays one vector of
            # partial sums until the part is finished.
            for o in range(outputs):
                total = zero
                for k in range(U(0), end, lanes):
                    total = total + load(above, o * b + k)
                _add(out, (first_b2 + o) * lanes, total)
            # Four hidden units at a time: their values are computed again, so that the forward pass need not keep them.
            for h in range(U(0), rows, U(GROUP)):
                for k in range(U(0), end, U(2) * lanes):
                    _hidden(k, lanes, encoded, w1, b1, h, width, two)
                    for r in range(U(GROUP)):
                        q, p = U(2) * r * lanes, r * b + k
                        to_unit, to_unit2 = zero, zero
                        for o in range(outputs):
                            w = splat(w2[o * rows + h + r])
                            to_unit = to_unit + w * load(above, o * b + k)
                            to_unit2 = to_unit2 + w * load(above, o * b + k + lanes)
                        x, y = load(two, q), load(two, q + lanes)
                        store(unit, p, where_positive(x, x))
                        store(unit, p + lanes, where_positive(y, y))
                        store(slope, p, where_positive(x, to_unit))
                        store(slope, p + lanes, where_positive(y, to_unit2))
                # `unit` now holds the units after ReLU, `slope` the gradients before it. Products of each with the
                # layer above and below give the gradients of both layers' weights.
                for o in range(outputs):
                    _add_products(end, lanes, unit, above, o * b, out, (first_w2 + o * rows + h) * lanes, lanes)
                for r in range(U(GROUP)):
                    total = zero
                    for k in range(U(0), end, lanes):
                        total = total + load(slope, r * b + k)
                    _add(out, (first_b1 + h + r) * lanes, total)
                for f in range(width):
                    _add_products(end, lanes, slope, encoded, f * b, out, (h * width + f) * lanes, width * lanes)
                    # The four units' share of the features' gradients.
                    w = h * width + f
                    wa, wb = splat(w1[w]), splat(w1[w + width])
                    wc, wd = splat(w1[w + U(2) * width]), splat(w1[w + U(3) * width])
                    for k in range(U(0), end, lanes):
                        left = wa * load(slope, k) + wb * load(slope, b + k)
                        right = wc * load(slope, U(2) * b + k) + wd * load(slope, U(3) * b + k)
                        _add(gradient, f * b + k, left + right)
        # The lanes of each sum, added in their order.
        for number in range(U(sums.shape[1])):
            total_of_lanes = dtype.type(0)
            for lane in range(number * lanes, (number + U(1)) * lanes):
                total_of_lanes += out[lane]
            sums[part, number] = total_of_lanes


@inner
def _add_products(end, lanes, rows, other, offset, out, index, step):  # type: ignore[no-untyped-def]
    """Adds the products of each of GROUP `rows` (GROUP, BLOCK) with one row of `other`, summed over points."""
    b = U(BLOCK)
    p = q = r = s = splat(rows.dtype.type(0))
    for k in range(U(0), end, lanes):
        x = load(other, offset + k)
        p = p + load(rows, k) * x
        q = q + load(rows, b + k) * x
        r = r + load(rows, U(2) * b + k) * x
        s = s + load(rows, U(3) * b + k) * x
    _add(out, index, p)
    _add(out, index + step, q)
    _add(out, index + U(2) * step, r)
    _add(out, index + U(3) * step, s)


@inner
def _add(out, index, vector):  # type: ignore[no-untyped-def]
    store(out, index, load(out, index) + vector)


@jit
def _table_gradient(start, stop, points, number_of, kept, to_features, resolutions, dense, features, out):  # type: ignore[no-untyped-def]
    """Writes the table's gradient of levels start..stop; adds the points in their order."""
    levels = resolutions.size
    width = U(out.size // levels)
    size = out.size // (levels * features)
    mask = np.uint32(size - 1)
    local = np.empty(3 * BLOCK, points.dtype)
    row = np.empty(8 * BLOCK, np.uint32)
    weight = np.empty(8 * BLOCK, points.dtype)
    fraction = np.empty(3 * BLOCK, points.dtype)
    # As in `hashgrid`, a thread owns whole levels. The points inside are packed again as the forward pass did it.
    for level in range(start, stop):
        entry = out[U(level) * width : U(level + 1) * width]
        entry[:] = 0
        direct = dense and (resolutions[level] + 1) ** 3 <= size
        for block in range(kept.size):
            numbers, count = number_of[block], U(kept[block])
            for k in range(count):
                i, j = U(3) * U(numbers[k]), U(3) * k
                local[j], local[j + U(1)], local[j + U(2)] = points[i], points[i + U(1)], points[i + U(2)]
            corners(local, 0, count, resolutions[level], direct, mask, row, weight, fraction)
            base = U(level * features * BLOCK)
            add_gradient(entry, to_features[block], base, U(1), U(BLOCK), count, U(features), row, weight)
