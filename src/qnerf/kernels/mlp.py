"""A multilayer perceptron in one loop each way, and its plain PyTorch reference.

All three products of a layer, of its values and of both gradients, are one function, `product`: it takes a tile of rows
times a few vectors of columns into registers. A block of points stays in the caches from the first layer to the last.

The backward pass sums the gradients of weights over parts of `PART` blocks, and then over the parts: they do not depend
on the number of threads.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import linear

from qnerf.kernels.hashgrid import ALL_POINTS, BLOCK, U
from qnerf.kernels.jit import flat, jit, run
from qnerf.kernels.loop import Loop
from qnerf.kernels.simd import (
    AVX512,
    VECTOR_BYTES,
    inner,
    keep_apart,
    load,
    start_of_line,
    store,
    tile,
    transpose,
    where_positive,
)

PART = 4  # blocks that one thread takes at a time
PAIR_ROWS = 8 if AVX512 else 4  # of a tile two vectors wide: its sums and what they are made of fill the registers


class Layer(NamedTuple):
    weight: Tensor  # (outputs, inputs)
    bias: Tensor  # (outputs,)


def mlp(rows: Tensor, layers: Sequence[Layer]) -> Tensor:
    """Values (N, O) of linear layers on rows (N, D), with ReLU between them.

    The gradients of rows, weights and biases equal those of `mlp_reference` to rounding.

    Raises:
        ValueError: a shape is not as above.
    """
    if rows.ndim != 2:
        raise ValueError(f"MLP: rows (N, D) expected, got the shape {tuple(rows.shape)}")
    check_layers(rows.shape[1], layers)
    values: Tensor = _MLP(rows, *(tensor for layer in layers for tensor in layer))
    return values


def mlp_reference(rows: Tensor, layers: Sequence[Layer]) -> Tensor:
    """`mlp` in plain PyTorch: any device, any dtype, differentiable any number of times."""
    for layer in layers[:-1]:
        rows = linear(rows, *layer).relu()
    return linear(rows, *layers[-1])


def check_layers(inputs: int, layers: Sequence[Layer]) -> None:
    """ValueError unless these are layers on so many features, each on the units of the one before."""
    widths = [inputs, *(len(layer.bias) for layer in layers)]
    expected = [((units, inputs), (units,)) for inputs, units in pairwise(widths)]
    got = [(tuple(weight.shape), tuple(bias.shape)) for weight, bias in layers]
    if not layers or got != expected:
        raise ValueError(f"MLP: layers on {inputs} features expected, got the shapes {got}")


def layers_of(parameters: Sequence[Tensor]) -> list[Layer]:
    """Weight, bias, weight, bias, ... as layers."""
    return [Layer(*parameters[i : i + 2]) for i in range(0, len(parameters), 2)]


def _forward(keeps: bool, rows: Tensor, *parameters: Tensor) -> tuple[Tensor, tuple[np.ndarray, ...]]:
    weights, widths = packed(parameters)
    blocks = -(-len(rows) // BLOCK)
    units = np.empty(keeps * blocks * BLOCK * int(widths[1:].sum()), weights.dtype)
    values = rows.new_empty(len(rows), int(widths[-1]))
    run(_values, blocks, rows, weights, widths, units, values, grain=PART)
    return values, (weights, widths, units)


def _backward(
    needs: Sequence[bool], inputs: Sequence[Tensor], kept: Sequence[np.ndarray], upstream: Tensor
) -> tuple[Tensor | None, ...]:
    (rows, *parameters), (weights, widths, units) = inputs, kept
    to_rows = torch.empty_like(rows, memory_format=torch.contiguous_format) if needs[0] else None
    sums = np.empty((-(-len(rows) // (PART * BLOCK)), len(weights)), weights.dtype)
    written = (weights[:0] if to_rows is None else to_rows, sums)
    run(gradients, len(sums), rows, units, weights, widths, *ALL_POINTS, *written, upstream, grain=1)
    return to_rows, *unpacked(sums.sum(0), parameters)


_MLP = Loop("MLP", lambda rows, *parameters: mlp_reference(rows, layers_of(parameters)), _forward, _backward)


def packed(parameters: Sequence[Tensor]) -> tuple[np.ndarray, np.ndarray]:
    """Weight, bias, weight, bias, ... in one flat array, and the widths: inputs, units of each layer."""
    widths = np.array([parameters[0].shape[1], *(bias.shape[0] for bias in parameters[1::2])], np.int64)
    return np.concatenate([flat(tensor) for tensor in parameters]), widths


def unpacked(array: np.ndarray, parameters: Sequence[Tensor]) -> list[Tensor]:
    """The parts of such an array, in the shapes of weight, bias, weight, bias, ..."""
    found, first = [], 0
    for parameter in parameters:
        size = parameter.numel()
        found.append(torch.from_numpy(array[first : first + size].reshape(parameter.shape)))
        first += size
    return found


_four, _two, _one = tile(4, 4), tile(PAIR_ROWS, 2), tile(8, 1)


@inner
def product(rows, wide, a, a_row, a_step, b, b_row, depth, low, c, c_row):  # type: ignore[no-untyped-def]
    """c (rows, wide) = max(c + a b, low), see `tile`. `wide` is whole vectors."""
    keep_apart()
    j, n = U(0), U(VECTOR_BYTES // a.itemsize)
    # With AVX-512 there are registers for 16 sums and more. Tiles of one vector are for what is left.
    while AVX512 and j + U(4) * n <= wide:
        for i in range(U(0), rows, U(4)):
            _four(i, j, rows, a, a_row, a_step, b, b_row, depth, low, c, c_row)
        j += U(4) * n
    while j + U(2) * n <= wide:
        for i in range(U(0), rows, U(PAIR_ROWS)):
            _two(i, j, rows, a, a_row, a_step, b, b_row, depth, low, c, c_row)
        j += U(2) * n
    while j < wide:
        for i in range(U(0), rows, U(8)):
            _one(i, j, rows, a, a_row, a_step, b, b_row, depth, low, c, c_row)
        j += n


@inner
def wide(units, array):  # type: ignore[no-untyped-def]
    """Units, filled up to whole vectors of the dtype of `array`."""
    n = U(VECTOR_BYTES // array.itemsize)
    return (U(units) + n - U(1)) // n * n


@inner
def aligned(size, array):  # type: ignore[no-untyped-def]
    """An array of the dtype of `array`, from the start of a cache line on. Vectors across two lines are slow."""
    found = np.empty(size + U(64 // array.itemsize), array.dtype)
    first = U(start_of_line(found))
    return found[first : first + size]


@inner
def units_of(widths, array):  # type: ignore[no-untyped-def]
    """Room for the units of `layers_values`."""
    size = U(0)
    for n in range(1, widths.size):
        size += U(widths[n]) * U(BLOCK)
    return aligned(size, array)


@inner
def layers_values(x, count, weights, widths, units):  # type: ignore[no-untyped-def]
    """Writes the units (units, BLOCK) of each layer for `count` points; returns where those of the last layer begin.

    `x` is (inputs, BLOCK).
    """
    w = place = U(0)
    b, columns = U(BLOCK), wide(count, x)
    for n in range(1, widths.size):
        inputs, outputs = U(widths[n - 1]), U(widths[n])
        found = units[place:]
        for u in range(outputs):
            for k in range(u * b, u * b + columns):
                found[k] = weights[w + inputs * outputs + u]
        low = x.dtype.type(0 if n < widths.size - 1 else -np.inf)
        product(outputs, columns, weights[w:], inputs, U(1), x, b, inputs, low, found, b)
        x = found
        w += (inputs + U(1)) * outputs
        place += outputs * b
    return place - U(widths[-1]) * b


class Work(NamedTuple):
    """What a thread needs for gradients."""

    weights: np.ndarray  # packed
    x: np.ndarray  # a block of inputs, and room for a vector behind it
    units: np.ndarray  # of `layers_values`
    to_values: np.ndarray  # (units, BLOCK), gradients of the last layer's units
    below: np.ndarray  # (units, BLOCK), of another layer's, or of the inputs
    spare: np.ndarray  # (units, BLOCK)
    across: np.ndarray  # (BLOCK, wide), what came into a layer, with rows and columns exchanged
    sums: (
        np.ndarray
    )  # gradients of weights: for each layer the units' rows of whole vectors, then a vector for each bias


@inner
def work(weights, widths):  # type: ignore[no-untyped-def]
    """A thread's `Work`."""
    size, most, b, lanes = U(0), wide(widths[0], weights), U(BLOCK), wide(1, weights)
    for n in range(1, widths.size):
        size += U(widths[n]) * (wide(widths[n - 1], weights) + lanes)
        most = max(most, wide(widths[n], weights))
    x, units, sums = aligned(U(widths[0]) * b + lanes, weights), units_of(widths, weights), aligned(size, weights)
    to_values, below = aligned(U(widths[-1]) * b, weights), aligned(most * b, weights)
    return Work(weights, x, units, to_values, below, aligned(most * b, weights), aligned(most * b, weights), sums)


@inner
def layers_gradients(x, x_row, count, widths, own, units, goes_on):  # type: ignore[no-untyped-def]
    """Adds the gradients of weights and biases for `count` points to own.sums. Returns those of x, if it `goes_on`.

    `x` is (inputs, BLOCK) or, unless `x_row` is 0, (BLOCK, inputs) with rows so far apart. `units` are those of
    `layers_values`. own.to_values holds the gradients of the values, and zeros to the end of the last vector.
    """
    low, one, b, lanes = x.dtype.type(-np.inf), U(1), U(BLOCK), wide(1, x)
    columns, above, below, spare = wide(count, x), own.to_values, own.below, own.spare
    w, i, place = U(own.weights.size), U(own.sums.size), U(units.size) - U(widths[-1]) * b
    for n in range(widths.size - 1, 0, -1):
        inputs, outputs, row = U(widths[n - 1]), U(widths[n]), wide(widths[n - 1], x)
        w -= (inputs + one) * outputs
        i -= (row + lanes) * outputs
        place -= inputs * b if n > 1 else U(0)
        came = units[place:] if n > 1 else x
        # Gradients of weights are products of the gradients above with what came in, summed over points. Those of one
        # unit fill vectors, so the inputs of one point have to lie together.
        across, across_row = own.across, row
        if n == 1 and x_row > U(0):
            across, across_row = x, x_row
        else:
            for f in range(U(0), inputs, lanes):
                for k in range(U(0), columns, lanes):
                    transpose(came, b, inputs, f, k, across, row)
        product(outputs, row, above, b, one, across, across_row, count, low, own.sums[i:], row)
        for u in range(outputs):
            bias = i + row * outputs + u * lanes
            total = load(own.sums, bias)
            for k in range(u * b, u * b + columns, lanes):
                total = total + load(above, k)
            store(own.sums, bias, total)
        # Gradients of what came in are sums over units, and 0 where ReLU was.
        if n > 1 or goes_on:
            below[: inputs * b] = 0
            product(inputs, columns, own.weights[w:], one, inputs, above, b, outputs, low, below, b)
        if n > 1:
            for f in range(U(0), inputs * b, b):
                for k in range(f, f + columns, lanes):
                    store(below, k, where_positive(load(came, k), load(below, k)))
        above, below, spare = below, spare, below
    return above


@inner
def packed_sums(own, widths, out):  # type: ignore[no-untyped-def]
    """Copies own.sums to `out`, which is packed as the weights; adds up the vectors of biases."""
    w, i, lanes = U(0), U(0), wide(1, out)
    for n in range(1, widths.size):
        inputs, outputs = U(widths[n - 1]), U(widths[n])
        row = wide(inputs, out)
        for u in range(outputs):
            for f in range(inputs):
                out[w + u * inputs + f] = own.sums[i + u * row + f]
            total = out.dtype.type(0)
            for lane in range(lanes):
                total += own.sums[i + outputs * row + u * lanes + lane]
            out[w + outputs * inputs + u] = total
        w += (inputs + U(1)) * outputs
        i += (row + lanes) * outputs


@jit
def _values(start, stop, rows, weights, widths, kept, values):  # type: ignore[no-untyped-def]
    """Writes the values of blocks start..stop and, unless `kept` is empty, their units."""
    inputs, outputs, b = U(widths[0]), U(widths[-1]), U(BLOCK)
    x, own = aligned(inputs * b, weights), units_of(widths, weights)
    for block in range(U(start), U(stop)):
        first, units = block * b, kept[block * U(own.size) :] if kept.size > 0 else own
        count = min(b, U(values.size) // outputs - first)
        for k in range(count):
            for f in range(inputs):
                x[f * b + k] = rows[(first + k) * inputs + f]
        at = layers_values(x, count, weights, widths, units)
        for k in range(count):
            for o in range(outputs):
                values[(first + k) * outputs + o] = units[at + o * b + k]


@jit
def gradients(  # type: ignore[no-untyped-def]
    start, stop, features, kept_units, weights, widths, number_of, kept, to_features, sums, upstream
):
    """Writes the gradients of the features of parts start..stop, and the sums (parts, all) of those of the weights.

    Args:
        features: of blocks of points: (inputs, BLOCK) each; or rows (N, inputs), with `kept_units`.
        kept_units: as `_values` kept them; empty: they are computed again.
        number_of: (blocks, BLOCK), the points of a block among the rows of `upstream`.
        kept: how many points each block has. Both are empty if the blocks are all points in turn.
        to_features: as features; empty: not wanted.
    """
    inputs, outputs, b, one = U(widths[0]), U(widths[-1]), U(BLOCK), U(1)
    own, goes_on, in_rows = work(weights, widths), to_features.size > 0, kept_units.size > 0
    points, size = U(upstream.size) // outputs, U(own.units.size)
    blocks = U(kept.size) if kept.size > 0 else (points + b - one) // b
    # Where feature f of point k is: k point + f feature.
    point, feature = (inputs, one) if in_rows else (one, b)
    for part in range(U(start), U(stop)):
        own.sums[:] = 0
        for block in range(part * U(PART), min((part + one) * U(PART), blocks)):
            first, base = block * b, block * b * inputs
            count = U(kept[block]) if kept.size > 0 else min(b, points - first)
            # A copy: they may be in no cache, and come faster one after another than as a product, which leaps, reads.
            for k in range(min(b * inputs, U(features.size) - base)):
                own.x[k] = features[base + k]
            units = kept_units[block * size : (block + one) * size] if in_rows else own.units
            if not in_rows:
                layers_values(own.x, count, weights, widths, units)
            for o in range(outputs):
                for k in range(count):
                    number = U(number_of[block, k]) if kept.size > 0 else first + k
                    own.to_values[o * b + k] = upstream[number * outputs + o]
                for k in range(count, wide(count, weights)):
                    own.to_values[o * b + k] = 0
            to_x = layers_gradients(own.x, inputs if in_rows else U(0), count, widths, own, units, goes_on)
            if goes_on:
                for k in range(count):
                    for f in range(inputs):
                        to_features[base + k * point + f * feature] = to_x[f * b + k]
        packed_sums(own, widths, sums[part])
