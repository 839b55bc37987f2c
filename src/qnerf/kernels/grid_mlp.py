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
from qnerf.kernels.derivatives import is_differentiated, through_reference
from qnerf.kernels.dispatch import serves
from qnerf.kernels.hashgrid import (
    BLOCK,
    U,
    check,
    empty,
    hash_encode_reference,
    interpolate,
    table_gradient,
)
from qnerf.kernels.jit import flat, jit, prepared
from qnerf.kernels.mlp import PART, Layer, Pass, layers_of
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
    parameters = (grid.table, *(tensor for layer in layers for tensor in layer))
    if serves("hash grid + MLP", points, *parameters):
        keeps = torch.is_grad_enabled() and any(parameter.requires_grad for parameter in parameters)
        values: Tensor = _GridMLP.apply(keeps, points, inside, grid.resolutions, grid.dense, *parameters)
        return values
    return grid_mlp_reference(points, inside, grid, layers)


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
        *parameters: Tensor,
    ) -> Tensor:
        network = Grid(table, resolutions, dense), layers_of(parameters)
        ctx.work = GridPass(points, inside, network, keeps)
        if keeps:
            ctx.save_for_backward(points, inside, resolutions, table, *parameters)
            ctx.dense = dense
        values: Tensor = ctx.work.forward()
        return values.detach()  # the result will point to `ctx`, which must not point back to it

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        points, inside, resolutions, table, *parameters = ctx.saved_tensors
        if is_differentiated(upstream):

            def reference(table: Tensor, *parameters: Tensor) -> Tensor:
                return grid_mlp_reference(points, inside, Grid(table, resolutions, ctx.dense), layers_of(parameters))

            return *[None] * 5, *through_reference(reference, (table, *parameters), upstream)
        return *[None] * 5, *ctx.work.gradients(upstream, empty(tuple(table.shape), flat(table).dtype))


class GridPass(Pass):
    """The loops in both directions at some points, with their buffers.

    Args:
        points: (N, 3), and which of them to evaluate, `inside` (N,); None: all. See `grid_mlp`.
        network: the grid and the layers on it.
        keeps: whether `gradients` may follow.
    """

    def __init__(
        self, points: Tensor, inside: Tensor | None, network: tuple[Grid, Sequence[Layer]], keeps: bool
    ) -> None:
        (table, resolutions, dense), layers = network
        blocks = -(-len(points) // BLOCK)
        kept, blocks = np.empty(blocks, np.int32), blocks if keeps else 0
        super().__init__(layers, -(-blocks // PART))
        self.keeps = keeps
        self.values = points.new_empty(len(points), len(layers[-1].bias))
        number_of = np.empty((blocks, BLOCK), np.int32)
        encoded, to_encoded = empty((2, blocks, BLOCK * int(self.widths[0])), self.weights.dtype).unbind()
        where = np.ones(0, np.bool_) if inside is None else inside
        grid = (resolutions, dense, table.shape[2])
        self.arrays = (table, *grid, self.weights, self.widths, encoded.numpy(), number_of, kept)
        """What `network_values` takes between the points and the values."""
        self._values = prepared(network_values, len(kept), points, where, *self.arrays, self.values, grain=PART)
        of_layers = (encoded, self.weights[:0], self.weights, self.widths, number_of, kept, to_encoded, self.sums)
        self._layers = prepared(mlp.gradients, len(self.sums), *of_layers, grain=1)
        of_table = (points, number_of, kept, to_encoded, *grid)
        self._table = prepared(table_gradient, len(table), *of_table, grain=1)

    def forward(self) -> Tensor:
        """The values (N, O)."""
        self._values(self.keeps)
        return self.values

    def gradients(self, upstream: Tensor, to_table: Tensor) -> list[Tensor]:
        """Of table, weights and biases, for the gradients (N, O) of the values. That of the table is written."""
        self._layers(flat(upstream))
        self._table(flat(to_table))
        return [to_table, *self.summed()]


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
    start, stop, points, inside, table, resolutions, dense, features, weights, widths, kept_features, number_of, kept,
    values, keeps,
):  # fmt: skip
    """Writes the values of blocks start..stop and, if `keeps`, the features and numbers of the points inside."""
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
        if keeps:
            # Loops: for an assignment of arrays Numba would also compile the message of a wrong shape, which takes 2 s.
            for i in range(encoded.size):
                kept_features[block, i] = encoded[i]
            for k in range(b):
                number_of[block, k] = numbers[k]
            kept[block] = count
