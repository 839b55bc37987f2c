"""The light-cone engine: every output as an explicit trigonometric polynomial of the few inputs it depends on.

With S = 1 an output of QIREN depends on three inputs, whatever the number of wires: 27 coefficients, computed once a
step. They come from interpolation. The circuit is evaluated exactly on a grid of equispaced angles, and a discrete
Fourier transform of those values gives the coefficients without error. Wires that share no cone can take the same grid
angle. They are found by colouring the wires, so that 8 wires need 81 evaluations, not 216. Any circuit with small cones
will do.
"""

from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import chain
from math import pi, prod
from typing import Any

import numpy as np
import torch
from torch import Tensor

from qnerf.kernels.jit import run
from qnerf.quantum import statevector
from qnerf.quantum.circuit import Circuit, readable_bytes
from qnerf.quantum.compiled import polynomial
from qnerf.quantum.compiled.engine import (
    StatevectorEngine,
    cos_sin,
    cos_sin_of_half,
    differentiable_gradients,
    flat_weights,
    from_blocks,
    numpy_dtype,
    parts_of,
    to_blocks,
)
from qnerf.quantum.compiled.simd import lanes
from qnerf.quantum.cones import Cones, TooLarge, find_cones
from qnerf.quantum.normal_form import normal_form

MAX_ENTRIES = 2**22  # of the interpolation matrix: 32 MiB


@dataclass(frozen=True)
class Interpolation:
    """Where to evaluate the circuit, and how to turn the values into coefficients.

    Attributes:
        cones: of the circuit.
        points: (points, n) input angles in radians.
        matrix: (outputs, most coefficients, points); coefficients = matrix @ values. Unused rows at the end are 0.
        highest_degree: of any wire.
        wires: (outputs, most wires) of each cone.
        basis_sizes: (outputs, most wires) number of basis functions 1, cos, sin, ... of each of these wires.
        wire_counts: (outputs,) wires in each cone.
        base_frequencies: (n,).
    """

    cones: Cones
    points: np.ndarray
    matrix: np.ndarray
    highest_degree: int
    wires: np.ndarray
    basis_sizes: np.ndarray
    wire_counts: np.ndarray
    base_frequencies: np.ndarray


@lru_cache(maxsize=64)
def interpolation(circuit: Circuit) -> Interpolation:
    """The interpolation grid of a circuit.

    Raises:
        TooLarge: the cones or the grid are too large.
    """
    cones = find_cones(circuit)
    n = circuit.wires
    degree = [0] * n
    for cone in cones.cones:
        for wire, value in zip(cone.wires, cone.degrees, strict=True):
            degree[wire] = max(degree[wire], value)
    colour = _colour_wires(cones, n)
    colours = max(colour, default=-1) + 1
    sizes = [max(2 * degree[wire] + 1 for wire in range(n) if colour[wire] == c) for c in range(colours)]
    most_coefficients = max(cone.coefficients for cone in cones.cones)
    if (entries := len(cones.cones) * most_coefficients * prod(sizes)) > MAX_ENTRIES:
        raise TooLarge(
            f"lightcone: ansatz {circuit.name} with {n} wires has an interpolation grid of {prod(sizes):,} points"
            f" and {readable_bytes(8 * entries)}; choose method=statevector or auto"
        )
    grid = np.stack(np.meshgrid(*(np.arange(size) for size in sizes), indexing="ij"), -1).reshape(-1, colours)
    base = np.array([frequency or 1.0 for frequency in cones.base_frequencies])
    grid_sizes = np.array(sizes)[colour] if colours else np.ones(n)
    points = (grid[:, colour] if colours else np.zeros((1, n))) * 2 * pi / grid_sizes / base
    most_wires = max(len(cone.wires) for cone in cones.cones)
    matrix = np.zeros((len(cones.cones), most_coefficients, len(points)))
    wires = np.zeros((len(cones.cones), max(most_wires, 1)), dtype=np.int64)
    basis_sizes = np.ones_like(wires)
    for output, cone in enumerate(cones.cones):
        rows = np.ones((1, len(points))) / len(points)
        for position, (wire, highest) in enumerate(zip(cone.wires, cone.degrees, strict=True)):
            angle = points[:, wire] * base[wire]
            basis = [np.ones(len(points))]
            for k in range(1, highest + 1):
                basis += [2 * np.cos(k * angle), 2 * np.sin(k * angle)]
            rows = (rows[:, None, :] * np.stack(basis)[None]).reshape(-1, len(points))
            wires[output, position], basis_sizes[output, position] = wire, 2 * highest + 1
        matrix[output, : len(rows)] = rows
    wire_counts = np.array([len(cone.wires) for cone in cones.cones])
    return Interpolation(cones, points, matrix, max(degree), wires, basis_sizes, wire_counts, base)


def _colour_wires(cones: Cones, n: int) -> list[int]:
    """A colour for each wire such that no cone holds a colour twice, with the fewest colours."""
    conflicts: list[set[int]] = [set() for _ in range(n)]
    for cone in cones.cones:
        for wire in cone.wires:
            conflicts[wire] |= set(cone.wires) - {wire}
    fewest = max((len(cone.wires) for cone in cones.cones), default=0)
    for colours in range(max(fewest, 1), n + 1):
        colouring = _extend_colouring(conflicts, colours, [])
        if colouring:
            return colouring
    return list(range(n))


def _extend_colouring(conflicts: list[set[int]], colours: int, chosen: list[int]) -> list[int] | None:
    """The colours chosen so far, completed to all wires by backtracking; None if that is impossible."""
    wire = len(chosen)
    if wire == len(conflicts):
        return chosen
    for colour in range(min(colours, max(chosen, default=-1) + 2)):
        if all(chosen[other] != colour for other in conflicts[wire] if other < wire):
            colouring = _extend_colouring(conflicts, colours, [*chosen, colour])
            if colouring:
                return colouring
    return None


class LightConeEngine:
    """A circuit with small light cones, ready to run on the CPU.

    Raises:
        TooLarge: the circuit has no small light cones.
    """

    def __init__(self, circuit: Circuit) -> None:
        self.circuit, self.grid = circuit, interpolation(circuit)
        self.engine = StatevectorEngine(normal_form(circuit))
        self.points = cos_sin_of_half(to_blocks(self.grid.points, lanes(8)), self.engine.arrays.encoding_scales)


def coefficients(circuit: Circuit, weights: Tensor) -> Tensor:
    """Coefficients (outputs, most coefficients) for stacked weights (rows, 3, n), differentiable; plain PyTorch."""
    grid = interpolation(circuit)
    points = torch.from_numpy(grid.points).to(weights.device, weights.dtype)
    return coefficients_of(grid, statevector.evaluate(normal_form(circuit), points, weights))


def coefficients_of(grid: Interpolation, values: Tensor) -> Tensor:
    """Coefficients (outputs, most coefficients) of the polynomials with these values (points, outputs) on the grid."""
    matrix = torch.from_numpy(grid.matrix).to(values.device, values.dtype)
    return torch.einsum("kcp,pk->kc", matrix, values)


def polynomials(circuit: Circuit, x: Tensor, coefficients: Tensor) -> Tensor:
    """The polynomials (B, outputs) with those coefficients at inputs x (B, n): plain PyTorch."""
    grid = interpolation(circuit)
    waves = [
        statevector.cos_sin(x, (order * grid.base_frequencies).tolist()) for order in range(1, grid.highest_degree + 1)
    ]
    basis = torch.stack([torch.ones_like(x.T), *chain.from_iterable(waves)], -1)  # (n, B, 2 highest_degree + 1)
    outputs = []
    for k, cone in enumerate(grid.cones.cones):
        value = coefficients[k, : cone.coefficients].expand(x.shape[0], -1)
        for wire, degree in zip(reversed(cone.wires), reversed(cone.degrees), strict=True):
            size = 2 * degree + 1
            value = (value.reshape(x.shape[0], value.shape[1] // size, size) * basis[wire, :, None, :size]).sum(-1)
        outputs.append(value.reshape(x.shape[0]))
    return statevector.clipped(torch.stack(outputs, -1))


class _Polynomials(torch.autograd.Function):
    """Coefficients by the compiled state-vector engine in float64, then the compiled polynomials."""

    @staticmethod
    def forward(ctx: Any, cone: LightConeEngine, x: Tensor, weights: Tensor) -> Tensor:
        grid = cone.grid
        bound = cone.engine.bind(flat_weights(weights), np.float64)
        values, expectations = bound.forward(cone.points)
        values = values.transpose(1, 0, 2).reshape(values.shape[1], -1, 1)[:, : len(grid.points)]
        dtype = numpy_dtype(x.dtype)
        table = np.matmul(grid.matrix, values)[..., 0].astype(dtype)
        angles = to_blocks(x.detach().numpy(), lanes(table.itemsize))
        trig = np.empty((angles.shape[0], 2, *angles.shape[1:]), dtype)
        cos_sin(angles, grid.base_frequencies, trig.swapaxes(0, 1))
        out = np.empty((trig.shape[0], len(grid.wire_counts), trig.shape[3]), dtype)
        parts = parts_of(trig)
        arguments = trig, trig.shape[3], grid.highest_degree, table, grid.wires, grid.basis_sizes, grid.wire_counts
        run(polynomial.evaluate, parts, parts, *arguments, out)
        ctx.save_for_backward(x, weights)
        ctx.saved = cone, bound, expectations, parts, arguments
        ctx.shapes = x.shape[0], weights.shape, weights.dtype
        return from_blocks(out, x.shape[0]).clamp_(-1, 1)  # rounding may lead beyond

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        cone, bound, expectations, parts, arguments = ctx.saved
        if torch.is_grad_enabled():
            return None, *differentiable_gradients(ctx, partial(evaluate_reference, cone.circuit), gradient)
        batch, shape, dtype = ctx.shapes
        grid, trig, table = cone.grid, arguments[0], arguments[3]
        width = trig.shape[3]
        inputs = np.empty((trig.shape[0], trig.shape[2], width), table.dtype)
        sums = np.empty((parts, *table.shape))
        run(polynomial.gradients, parts, parts, *arguments, to_blocks(gradient.detach().numpy(), width), inputs, sums)
        to_values = np.zeros((len(grid.wire_counts), cone.points.shape[0] * cone.points.shape[-1]))
        to_values[:, : len(grid.points)] = np.matmul(sums.sum(0)[:, None], grid.matrix)[:, 0]
        to_values = to_values.reshape(len(to_values), -1, cone.points.shape[-1]).transpose(1, 0, 2)
        _, to_weights = bound.backward(cone.points, expectations, np.ascontiguousarray(to_values))
        inputs *= grid.base_frequencies[:, None].astype(table.dtype)
        dx = from_blocks(inputs, batch)
        return None, dx, torch.from_numpy(to_weights).to(dtype).reshape(shape)


def evaluate(cone: LightConeEngine, x: Tensor, weights: Tensor) -> Tensor:
    """Expectation values (B, outputs) for inputs x (B, n) in radians and stacked weights (rows, 3, n), on the CPU."""
    return _Polynomials.apply(cone, x, weights)


def evaluate_reference(circuit: Circuit, x: Tensor, weights: Tensor) -> Tensor:
    """What `evaluate` computes, in plain PyTorch, on any device."""
    return polynomials(circuit, x, coefficients(circuit, weights))
