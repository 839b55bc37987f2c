"""The light-cone engine: every output as an explicit trigonometric polynomial of the few inputs it depends on.

With S = 1 an output of QIREN depends on three inputs, whatever the number of wires: 27 coefficients, computed once a
step. They come from interpolation. The circuit is evaluated exactly on a grid of equispaced angles, and a discrete
Fourier transform of those values gives the coefficients without error. Wires that share no cone can take the same grid
angle. They are found by colouring the wires, so that 8 wires need 81 evaluations, not 216. Any circuit with small cones
will do. A wide one is several smaller ones (`registers`).
"""

from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import chain
from math import pi, prod
from typing import Any

import numpy as np
import torch
from torch import Tensor

from qnerf.kernels.derivatives import is_differentiated, through_reference
from qnerf.kernels.jit import run
from qnerf.kernels.simd import lanes
from qnerf.quantum import statevector
from qnerf.quantum.circuit import Circuit, readable_bytes
from qnerf.quantum.compiled import polynomial
from qnerf.quantum.compiled.engine import (
    StatevectorEngine,
    by_row,
    cos_sin,
    cos_sin_of_half,
    from_blocks,
    numpy_dtype,
    parts_of,
    to_blocks,
)
from qnerf.quantum.cones import Cones, TooLarge, find_cones
from qnerf.quantum.normal_form import normal_form

MAX_ENTRIES = 2**22  # of the interpolation matrix: 32 MiB


@dataclass(frozen=True)
class PolynomialForm:
    """Which polynomials the outputs of a circuit are.

    Attributes:
        cones: of the circuit; the coefficients of output k are ordered as `cones.cones[k]` is.
        highest_degree: of any wire.
        used: the wires that are in any cone.
        wires: (outputs, most wires) of each cone, as places in `used`.
        basis_sizes: (outputs, most wires) number of basis functions 1, cos, sin, ... of each of these wires.
        wire_counts: (outputs,) wires in each cone.
        base_frequencies: (n,).
    """

    cones: Cones
    highest_degree: int
    used: np.ndarray
    wires: np.ndarray
    basis_sizes: np.ndarray
    wire_counts: np.ndarray
    base_frequencies: np.ndarray

    @property
    def most_coefficients(self) -> int:
        return max(cone.coefficients for cone in self.cones.cones)


@dataclass(frozen=True)
class Interpolation:
    """Where to evaluate a circuit, and how to turn the values into coefficients.

    Attributes:
        points: (points, n) input angles in radians.
        matrix: (outputs, most coefficients, points); coefficients = matrix @ values. Unused rows at the end are 0.
    """

    points: np.ndarray
    matrix: np.ndarray


@lru_cache(maxsize=64)
def polynomial_form(circuit: Circuit) -> PolynomialForm:
    """The polynomials of a circuit.

    Raises:
        TooLarge: the cones are too large.
    """
    cones = find_cones(circuit)
    most_wires = max(len(cone.wires) for cone in cones.cones)
    used = sorted({wire for cone in cones.cones for wire in cone.wires})
    wires = np.zeros((len(cones.cones), max(most_wires, 1)), dtype=np.int64)
    basis_sizes = np.ones_like(wires)
    for output, cone in enumerate(cones.cones):
        for position, (wire, highest) in enumerate(zip(cone.wires, cone.degrees, strict=True)):
            wires[output, position], basis_sizes[output, position] = used.index(wire), 2 * highest + 1
    wire_counts = np.array([len(cone.wires) for cone in cones.cones])
    base = np.array([frequency or 1.0 for frequency in cones.base_frequencies])
    highest = int(basis_sizes.max()) // 2
    return PolynomialForm(cones, highest, np.array(used, dtype=np.int64), wires, basis_sizes, wire_counts, base)


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
    matrix = np.zeros((len(cones.cones), most_coefficients, len(points)))
    for output, cone in enumerate(cones.cones):
        rows = np.ones((1, len(points))) / len(points)
        for wire, highest in zip(cone.wires, cone.degrees, strict=True):
            angle = points[:, wire] * base[wire]
            basis = [np.ones(len(points))]
            for k in range(1, highest + 1):
                basis += [2 * np.cos(k * angle), 2 * np.sin(k * angle)]
            rows = (rows[:, None, :] * np.stack(basis)[None]).reshape(-1, len(points))
        matrix[output, : len(rows)] = rows
    return Interpolation(points, matrix)


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
        self.circuit, self.form, self.grid = circuit, polynomial_form(circuit), interpolation(circuit)
        self.engine = StatevectorEngine(normal_form(circuit))
        self.points = cos_sin_of_half(to_blocks(self.grid.points, lanes(8)), self.engine.arrays.encoding_scales)


class _BoundGrid:
    """A circuit on its grid with its weights, (rows, n, 3) float64 in radians."""

    def __init__(self, cone: LightConeEngine, weights: np.ndarray) -> None:
        self.grid, self.points, self.bound = cone.grid, cone.points, cone.engine.bind(weights, np.float64)

    def coefficients(self) -> np.ndarray:
        """(outputs, most coefficients)."""
        values, self.expectations = self.bound.forward(self.points)
        values = values.transpose(1, 0, 2).reshape(values.shape[1], -1, 1)[:, : len(self.grid.points)]
        out: np.ndarray = np.matmul(self.grid.matrix, values)[..., 0]
        return out

    def backward(self, gradient: np.ndarray) -> np.ndarray:
        """Gradient of the weights from the gradient of the coefficients."""
        blocks, width = self.points.shape[0], self.points.shape[-1]
        to_values = np.zeros((len(gradient), blocks * width))
        to_values[:, : len(self.grid.points)] = np.matmul(gradient[:, None], self.grid.matrix)[:, 0]
        to_values = to_values.reshape(len(to_values), blocks, width).transpose(1, 0, 2)
        return self.bound.backward(self.points, self.expectations, np.ascontiguousarray(to_values))[1]


def coefficients(circuit: Circuit, weights: Tensor) -> Tensor:
    """Coefficients (outputs, most coefficients) for flat weights, differentiable; plain PyTorch."""
    grid = interpolation(circuit)
    points = torch.from_numpy(grid.points).to(weights.device, weights.dtype)
    return coefficients_of(grid, statevector.evaluate(normal_form(circuit), points, weights))


def coefficients_of(grid: Interpolation, values: Tensor) -> Tensor:
    """Coefficients (outputs, most coefficients) of the polynomials with these values (points, outputs) on the grid."""
    matrix = torch.from_numpy(grid.matrix).to(values.device, values.dtype)
    return torch.einsum("kcp,pk->kc", matrix, values)


def polynomials(circuit: Circuit, x: Tensor, coefficients: Tensor) -> Tensor:
    """The polynomials (B, outputs) with those coefficients at inputs x (B, n): plain PyTorch."""
    form = polynomial_form(circuit)
    waves = [
        statevector.cos_sin(x, (order * form.base_frequencies).tolist()) for order in range(1, form.highest_degree + 1)
    ]
    basis = torch.stack([torch.ones_like(x.T), *chain.from_iterable(waves)], -1)  # (n, B, 2 highest_degree + 1)
    outputs = []
    for k, cone in enumerate(form.cones.cones):
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
        form, bound = cone.form, _BoundGrid(cone, by_row(weights, cone.circuit))
        dtype = numpy_dtype(x.dtype)
        table = bound.coefficients().astype(dtype)
        angles = to_blocks(x.detach().numpy()[:, form.used], lanes(table.itemsize))
        trig = np.empty((angles.shape[0], 2, *angles.shape[1:]), dtype)
        cos_sin(angles, form.base_frequencies[form.used], trig.swapaxes(0, 1))
        out = np.empty((trig.shape[0], len(form.wire_counts), trig.shape[3]), dtype)
        parts = parts_of(trig)
        found = polynomial.Polynomials(form.highest_degree, table, form.wires, form.basis_sizes, form.wire_counts)
        arguments = trig, trig.shape[3], found
        run(polynomial.evaluate, parts, parts, *arguments, out)
        ctx.save_for_backward(x, weights)
        ctx.saved = cone, bound, parts, arguments
        ctx.shapes = x.shape[0], weights.shape, weights.dtype
        # Rounding may lead beyond. PyTorch would share this with threads, which then spin beside the loops.
        return from_blocks(np.clip(out, -1, 1, out=out), x.shape[0])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        cone, bound, parts, arguments = ctx.saved
        if is_differentiated(gradient):
            return None, *through_reference(partial(evaluate_reference, cone.circuit), ctx.saved_tensors, gradient)
        batch, shape, dtype = ctx.shapes
        trig, table = arguments[0], arguments[2].coefficients
        width = trig.shape[3]
        inputs = np.empty((trig.shape[0], trig.shape[2], width), table.dtype)
        sums = np.empty((parts, *table.shape))
        upstream = to_blocks(gradient.detach().resolve_neg().numpy(), width)
        run(polynomial.gradients, parts, parts, *arguments, upstream, inputs, sums)
        to_weights = bound.backward(sums.sum(0))
        inputs *= cone.form.base_frequencies[cone.form.used][:, None].astype(table.dtype)
        dx = np.zeros((batch, cone.circuit.wires), table.dtype)
        dx[:, cone.form.used] = from_blocks(inputs, batch)
        return None, torch.from_numpy(dx), torch.from_numpy(to_weights).to(dtype).reshape(shape)


def evaluate(cone: LightConeEngine, x: Tensor, weights: Tensor) -> Tensor:
    """Expectation values (B, outputs) for inputs x (B, n) in radians and flat weights, on the CPU."""
    return _Polynomials.apply(cone, x, weights)


def evaluate_reference(circuit: Circuit, x: Tensor, weights: Tensor) -> Tensor:
    """What `evaluate` computes, in plain PyTorch, on any device."""
    return polynomials(circuit, x, coefficients(circuit, weights))
