"""A multilayer perceptron in one loop each way, and its plain PyTorch reference.

All three products of a layer, of its values and of both gradients, are one function, `product`: it takes a tile of rows
times a few vectors of columns into registers. A block of points stays in the caches from the first layer to the last.

The backward pass computes the hidden units again. It sums the gradients of weights over parts of `PART` blocks, and
then over the parts: they do not depend on the number of threads.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import linear

from qnerf.kernels.derivatives import is_differentiated, through_reference
from qnerf.kernels.dispatch import serves
from qnerf.kernels.hashgrid import BLOCK, U
from qnerf.kernels.jit import flat, jit, run
from qnerf.kernels.simd import AVX512, VECTOR_BYTES, inner, keep_apart, load, start_of_line, store, tile, where_positive

PART = 8  # blocks that one thread takes at a time
PAIR_ROWS = 8 if AVX512 else 4  # of a tile two vectors wide: its sums and what they are made of fill the registers


ALL_POINTS = (np.empty((0, BLOCK), np.int32), np.empty(0, np.int32))  # `gradients` of all points in turn


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
    parameters = [tensor for layer in layers for tensor in layer]
    if serves("MLP", rows, *parameters):
        values: Tensor = _MLP.apply(rows, *parameters)
        return values
    return mlp_reference(rows, layers)


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


class _MLP(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rows: Tensor, *parameters: Tensor) -> Tensor:
        ctx.save_for_backward(rows, *parameters)
        ctx.packed = packed(layers_of(parameters))
        values = rows.new_empty(len(rows), len(parameters[-1]))
        run(_values, -(-len(rows) // BLOCK), flat(rows), *ctx.packed, flat(values), grain=PART)
        return values

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        rows, *parameters = ctx.saved_tensors
        if is_differentiated(upstream):

            def reference(rows: Tensor, *parameters: Tensor) -> Tensor:
                return mlp_reference(rows, layers_of(parameters))

            return tuple(through_reference(reference, (rows, *parameters), upstream))
        weights, widths = ctx.packed
        to_rows = torch.empty_like(rows, memory_format=torch.contiguous_format) if ctx.needs_input_grad[0] else None
        sums = np.empty((-(-len(rows) // (PART * BLOCK)), len(weights)), weights.dtype)
        arrays = (flat(rows), rows.shape[1], 1, weights, widths, *ALL_POINTS)
        to = weights[:0] if to_rows is None else flat(to_rows)
        run(gradients, len(sums), *arrays, to, sums, flat(upstream), grain=1)
        return to_rows, *unpacked(sums.sum(0), parameters)


def packed(layers: Sequence[Layer]) -> tuple[np.ndarray, np.ndarray]:
    """Weight, bias, weight, bias, ... of all layers in one flat array, and the widths: inputs, units of each layer."""
    widths = np.array([layers[0].weight.shape[1], *(len(layer.bias) for layer in layers)], np.int64)
    return np.concatenate([flat(tensor) for layer in layers for tensor in layer]), widths


def unpacked(array: np.ndarray, parameters: Sequence[Tensor]) -> list[Tensor]:
    """The parts of such an array, in the shapes of weight, bias, weight, bias, ..."""
    found, first = [], 0
    for parameter in parameters:
        size = parameter.numel()
        found.append(torch.from_numpy(array[first : first + size].reshape(parameter.shape)))
        first += size
    return found


_four, _two, _one = tile(4, 4), tile(8 if AVX512 else 4, 2), tile(8, 1)


@inner
def product(count, a, a_row, a_step, b, b_row, depth, start, start_row, low, c, wide):  # type: ignore[no-untyped-def]
    """Writes c = max(a b + start, low), see `tile`; its rows are `wide`, which is whole vectors."""
    keep_apart()
    j, n = U(0), U(VECTOR_BYTES // a.itemsize)
    # AVX-512 has twice as many registers.
    while AVX512 and j + U(4) * n <= wide:
        for i in range(U(0), count, U(4)):
            _four(i, j, count, a, a_row, a_step, b, b_row, depth, start, start_row, low, c, wide)
        j += U(4) * n
    while j + U(2) * n <= wide:
        for i in range(U(0), count, U(8 if AVX512 else 4)):
            _two(i, j, count, a, a_row, a_step, b, b_row, depth, start, start_row, low, c, wide)
        j += U(2) * n
    while j < wide:
        for i in range(U(0), count, U(8)):
            _one(i, j, count, a, a_row, a_step, b, b_row, depth, start, start_row, low, c, wide)
        j += n


class Work(NamedTuple):
    """What a thread needs on the way."""

    by_input: np.ndarray  # of each layer a row of weights for each input, and a row of biases, in whole vectors
    by_unit: np.ndarray  # the packed weights, and room behind them, where rows are read to the end of their vectors
    sums: np.ndarray  # of the gradients of weights, as `by_input`
    x: np.ndarray  # a block of inputs
    units: np.ndarray  # (BLOCK, wide) of each layer, one after another
    to_values: np.ndarray  # (BLOCK, wide) gradients of the last layer's units, and zeros behind them
    below: np.ndarray  # (BLOCK, wide)
    spare: np.ndarray  # (BLOCK, wide)
    zero: np.ndarray  # a row
    one: np.ndarray  # (1,)


@inner
def wide(units, array):  # type: ignore[no-untyped-def]
    """Units, filled up to whole vectors of the dtype of `array`."""
    n = U(VECTOR_BYTES // array.itemsize)
    return (U(units) + n - U(1)) // n * n


@inner
def _aligned(size, array):  # type: ignore[no-untyped-def]
    """An array of the dtype of `array`, from the start of a cache line on. Vectors across two lines are slow."""
    found = np.empty(size + U(64 // array.itemsize), array.dtype)
    first = U(start_of_line(found))
    return found[first : first + size]


@inner
def work(weights, widths):  # type: ignore[no-untyped-def]
    """A thread's `Work` with these packed weights."""
    size, units, most, b = U(0), U(0), wide(widths[0], weights), U(BLOCK)
    for n in range(1, widths.size):
        row = wide(widths[n], weights)
        size += (U(widths[n - 1]) + U(1)) * row
        units += row
        most = max(most, row)
    own = Work(
        by_input=_aligned(size, weights),
        by_unit=_aligned(U(weights.size) + U(VECTOR_BYTES), weights),
        sums=_aligned(size, weights),
        x=_aligned(b * U(widths[0]), weights),
        units=_aligned(b * units, weights),
        to_values=_aligned(b * wide(widths[-1], weights), weights),
        below=_aligned(b * most, weights),
        spare=_aligned(b * most, weights),
        zero=_aligned(most, weights),
        one=_aligned(U(1), weights),
    )
    own.by_input[:], own.by_unit[:], own.to_values[:], own.zero[:], own.one[:] = 0, 0, 0, 0, 1
    for i in range(weights.size):
        own.by_unit[i] = weights[i]
    _by_input(own.by_unit, widths, own.by_input, U(0))
    return own


@inner
def _by_input(weights, widths, rows, back):  # type: ignore[no-untyped-def]
    """Copies packed weights to `Work.by_input` or, if `back` is 1, from there."""
    w = i = U(0)
    for n in range(1, widths.size):
        inputs, units, row = U(widths[n - 1]), U(widths[n]), wide(widths[n], weights)
        for u in range(units):
            for f in range(inputs + U(1)):
                place = w + u * inputs + f if f < inputs else w + units * inputs + u
                if back:
                    weights[place] = rows[i + f * row + u]
                else:
                    rows[i + f * row + u] = weights[place]
        w += (inputs + U(1)) * units
        i += (inputs + U(1)) * row


@inner
def layers_forward(x, x_row, x_step, count, widths, own):  # type: ignore[no-untyped-def]
    """Writes own.units for `count` points, and returns where those of the last layer begin.

    Feature f of point k is x[k x_row + f x_step].
    """
    w = place = at = U(0)
    for n in range(1, widths.size):
        inputs, row = U(widths[n - 1]), wide(widths[n], x)
        low = x.dtype.type(0 if n < widths.size - 1 else -np.inf)  # ReLU, but not after the last
        layer, biases, units = own.by_input[w:], own.by_input[w + inputs * row :], own.units[place:]
        product(count, x, x_row, x_step, layer, row, inputs, biases, U(0), low, units, row)
        x, x_row, x_step, at = units, row, U(1), place
        place += U(BLOCK) * row
        w += (inputs + U(1)) * row
    return at


@inner
def layers_backward(x, x_row, x_step, count, widths, own, goes_on):  # type: ignore[no-untyped-def]
    """Adds the gradients of weights and biases for `count` points to own.sums, after `layers_forward`.

    own.to_values holds the gradients of the values. Returns those of x (BLOCK, wide), if the loop `goes_on` to them.
    """
    low, one, zero = x.dtype.type(-np.inf), U(1), U(0)
    above, below, spare = own.to_values, own.below, own.spare
    w, packed, place = (
        U(own.sums.size),
        U(own.by_unit.size) - U(VECTOR_BYTES),
        U(own.units.size) - U(BLOCK) * wide(widths[-1], x),
    )
    for n in range(widths.size - 1, 0, -1):
        inputs, units = U(widths[n - 1]), U(widths[n])
        row, other = wide(units, x), wide(inputs, x)
        w -= (inputs + one) * row
        packed -= (inputs + one) * units
        place -= U(BLOCK) * other  # of the units that came in
        # Gradients of weights are products of what came in with the gradients above, summed over points. Those of
        # biases are the same for an input that is always 1.
        sums, biases = own.sums[w:], own.sums[w + inputs * row :]
        if n == 1:
            product(inputs, x, x_step, x_row, above, row, count, sums, row, low, sums, row)
        else:
            product(inputs, own.units[place:], one, other, above, row, count, sums, row, low, sums, row)
        product(one, own.one, zero, zero, above, row, count, biases, zero, low, biases, row)
        # Gradients of what came in: sums over units, and 0 where ReLU was.
        if n > 1 or goes_on:
            product(count, above, row, one, own.by_unit[packed:], inputs, units, own.zero, zero, low, below, other)
        if n > 1:
            for k in range(zero, count * other, U(VECTOR_BYTES // x.itemsize)):
                store(below, k, where_positive(load(own.units, place + k), load(below, k)))
        above, below, spare = below, spare, below
    return above


@jit
def _values(start, stop, rows, weights, widths, values):  # type: ignore[no-untyped-def]
    """Writes the values of blocks start..stop."""
    inputs, outputs, b = U(widths[0]), U(widths[-1]), U(BLOCK)
    own, row = work(weights, widths), wide(outputs, weights)
    for first in range(U(start) * b, min(U(stop) * b, U(values.size) // outputs), b):
        count = min(b, U(values.size) // outputs - first)
        # A copy: rows that are in no cache come faster one after another than as a product, which leaps, reads them.
        for k in range(count * inputs):
            own.x[k] = rows[first * inputs + k]
        at = layers_forward(own.x, inputs, U(1), count, widths, own)
        for k in range(count):
            for o in range(outputs):
                values[(first + k) * outputs + o] = own.units[at + k * row + o]


@jit
def gradients(  # type: ignore[no-untyped-def]
    start, stop, features, x_row, x_step, weights, widths, number_of, kept, to_features, sums, upstream
):
    """Writes the gradients of the features of parts start..stop, and the sums (parts, all) of those of the weights.

    Args:
        features: flat, blocks of points one after another; x_row and x_step as in `layers_forward`.
        number_of: (blocks, BLOCK), the points of a block among the rows of `upstream`.
        kept: how many points each block has. Both are empty if the blocks are all points in turn.
        to_features: as features; empty: not wanted.
    """
    inputs, outputs, b, one = U(widths[0]), U(widths[-1]), U(BLOCK), U(1)
    own, row, other = work(weights, widths), wide(outputs, weights), wide(inputs, weights)
    points, goes_on, point, feature = U(upstream.size) // outputs, to_features.size > 0, U(x_row), U(x_step)
    blocks = U(kept.size) if kept.size > 0 else (points + b - one) // b
    for part in range(U(start), U(stop)):
        own.sums[:] = 0
        for block in range(part * U(PART), min((part + one) * U(PART), blocks)):
            first, base = block * b, block * b * inputs
            count = U(kept[block]) if kept.size > 0 else min(b, points - first)
            # The units again, so that the forward pass need not keep them.
            for k in range(min(b * inputs, U(features.size) - base)):
                own.x[k] = features[base + k]
            layers_forward(own.x, point, feature, count, widths, own)
            for k in range(count):
                number = U(number_of[block, k]) if kept.size > 0 else first + k
                for o in range(outputs):
                    own.to_values[k * row + o] = upstream[number * outputs + o]
            to_x = layers_backward(own.x, point, feature, count, widths, own, goes_on)
            if goes_on:
                for k in range(count):
                    for f in range(inputs):
                        to_features[base + k * point + f * feature] = to_x[k * other + f]
        _by_input(sums[part], widths, own.sums, one)
