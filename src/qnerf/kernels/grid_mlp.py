"""A hash grid and an MLP on its features, in one loop each way, and their plain PyTorch reference.

This is a proposal network, and the density of a classical field. A block of points stays in the caches from its cells
to the outputs. Points that are not `inside` cost nothing.

The backward pass keeps the features, computes the units again, and sums the gradients of the weights over parts of
`PART` blocks, and then over the parts: they do not depend on the number of threads.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from qnerf.kernels import mlp
from qnerf.kernels.hashgrid import (
    BLOCK,
    U,
    check,
    empty_like,
    hash_encode_reference,
    interpolate,
    table_gradient,
)
from qnerf.kernels.jit import jit, run
from qnerf.kernels.loop import Loop
from qnerf.kernels.mlp import PART, Layer, layers_of
from qnerf.kernels.simd import inner


class Grid(NamedTuple):
    """What `hash_encode` takes besides the points."""

    table: Tensor  # (L, T, F)
    resolutions: Tensor  # (L,) int64
    dense: bool


def grid_mlp(points: Tensor, inside: Tensor | None, grid: Grid, layers: Sequence[Layer]) -> Tensor:
    """Values (N, O) of linear layers, with ReLU between them, on the features at the points.

    The gradients of table, weights and biases equal those of `grid_mlp_reference` to rounding. The points get none.

    Args:
        points: (N, 3) in the unit cube.
        inside: (N,) bool, the points to evaluate; the others have the values -inf, 0, 0, ..., which make no density.
            None: all.
        grid: a hash grid of L levels with F features each.
        layers: the first one on L F features.

    Raises:
        ValueError: the points need a gradient, or a shape or dtype is not as above.
    """
    if points.requires_grad:
        raise ValueError("grid_mlp: points without gradient expected; hash_encode and linear layers give them one")
    check(points, grid.table, grid.resolutions)
    levels, _, features = grid.table.shape
    mlp.check_layers(levels * features, layers)
    if inside is not None and (inside.shape != points.shape[:1] or inside.dtype != torch.bool):
        raise ValueError(f"grid_mlp: inside must be bool ({len(points)},), got {inside.dtype} {tuple(inside.shape)}")
    parameters = (tensor for layer in layers for tensor in layer)
    values: Tensor = _GRID_MLP(points, inside, grid.resolutions, grid.dense, grid.table, *parameters)
    return values


def grid_mlp_reference(points: Tensor, inside: Tensor | None, grid: Grid, layers: Sequence[Layer]) -> Tensor:
    """`grid_mlp` in plain PyTorch: any device, any dtype, differentiable any number of times."""
    values = mlp.mlp_reference(hash_encode_reference(points, *grid), layers)
    if inside is None:
        return values
    return torch.where(inside[:, None], values, _outside(values))


def _outside(values: Tensor) -> Tensor:
    """The values (O,) of a point that is not evaluated."""
    row = values.new_zeros(values.shape[1])
    row[0] = -torch.inf
    return row


def _forward(
    keeps: bool,
    points: Tensor,
    inside: Tensor | None,
    resolutions: Tensor,
    dense: bool,
    table: Tensor,
    *parameters: Tensor,
) -> tuple[Tensor, tuple[np.ndarray, ...]]:
    weights, widths = mlp.packed(parameters)
    blocks = -(-len(points) // BLOCK)
    encoded = np.empty((keeps * blocks, BLOCK * int(widths[0])), weights.dtype)
    number_of, counts = np.empty((keeps * blocks, BLOCK), np.int32), np.empty(keeps * blocks, np.int32)
    values = points.new_empty(len(points), int(widths[-1]))
    where = np.ones(0, np.bool_) if inside is None else inside
    grid, kept = (table, resolutions, dense, table.shape[2]), (encoded, number_of, counts)
    run(network_values, blocks, points, where, grid, (weights, widths), kept, values, grain=PART)
    return values, (weights, widths, encoded.reshape(-1), number_of, counts)


def _backward(
    needs: Sequence[bool], inputs: Sequence[Any], kept: Sequence[np.ndarray], upstream: Tensor
) -> tuple[Tensor | None, ...]:
    points, _, resolutions, dense, table, *parameters = inputs
    weights, widths, encoded, *of_blocks = kept
    to_encoded, to_table = np.empty_like(encoded), empty_like(table)
    sums = np.empty((-(-len(points) // (PART * BLOCK)), len(weights)), weights.dtype)
    arrays = (encoded, weights[:0], weights, widths, *of_blocks)
    run(mlp.gradients, len(sums), *arrays, to_encoded, sums, upstream, grain=1)
    grid = (resolutions, dense, table.shape[2])
    run(table_gradient, len(table), points, *of_blocks, to_encoded, *grid, to_table, grain=1)
    return None, None, None, None, to_table, *mlp.unpacked(sums.sum(0), parameters)


def _reference(
    points: Tensor, inside: Tensor | None, resolutions: Tensor, dense: bool, table: Tensor, *parameters: Tensor
) -> Tensor:
    return grid_mlp_reference(points, inside, Grid(table, resolutions, dense), layers_of(parameters))


_GRID_MLP = Loop("hash grid + MLP", _reference, _forward, _backward)


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
def network_values(start, stop, points, inside, grid, layers, backward, values):  # type: ignore[no-untyped-def]
    """Writes the values of blocks start..stop and, unless `kept` is empty, what the backward pass needs."""
    table, resolutions, dense, features = grid
    weights, widths = layers
    kept_features, number_of, kept = backward
    zero = points.dtype.type(0)
    width, outputs, b = U(widths[0]), U(widths[-1]), U(BLOCK)
    local = np.empty(3 * BLOCK, points.dtype)
    numbers = np.empty(BLOCK + 1, np.int32)
    row = np.zeros(8 * BLOCK, np.uint32)
    weight = np.zeros(8 * BLOCK, points.dtype)
    fraction = np.empty(3 * BLOCK, points.dtype)
    encoded = mlp.aligned(width * b, points)
    units = mlp.units_of(widths, points)
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
        at = mlp.layers_values(encoded, count, weights, widths, units)
        for o in range(outputs):
            for k in range(count):
                values[U(numbers[k]) * outputs + o] = units[at + o * b + k]
        # What the backward pass needs.
        if kept.size > 0:
            # Loops: for an assignment of arrays Numba would also compile the message of a wrong shape, which takes 2 s.
            for i in range(encoded.size):
                kept_features[block, i] = encoded[i]
            for k in range(b):
                number_of[block, k] = numbers[k]
            kept[block] = count
