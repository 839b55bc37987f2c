"""Light-cone evaluation: every output as an explicit trigonometric polynomial of the few inputs it depends on.

With S = 1 an output of QIREN depends on three inputs, whatever the number of wires: 27 coefficients, once a step.
They come from interpolation: the circuit is evaluated exactly on a grid of equispaced angles, and a discrete Fourier
transform of those values gives the coefficients without error. Wires that share no cone take their grid angles
together (a colouring of the wires), so 8 wires need 81 evaluations, not 216. Any description with small cones can be
treated.
"""

from dataclasses import dataclass
from functools import lru_cache
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
    PARTS,
    Engine,
    blocked,
    flat_weights,
    numpy_dtype,
    trigonometry,
    unblocked,
    waves,
)
from qnerf.quantum.compiled.simd import lanes
from qnerf.quantum.cones import Cones, TooLarge, find_cones
from qnerf.quantum.normal_form import compile_program

MAX_ENTRIES = 2**22  # of the interpolation matrix: 32 MiB


@dataclass(frozen=True)
class Interpolation:
    """Where to evaluate the circuit, and how to turn the values into coefficients."""

    cones: Cones
    points: np.ndarray  # (points, n) radians
    matrix: np.ndarray  # (outputs, most coefficients, points): coefficients = matrix @ values, zero rows behind
    most: int  # highest degree of any wire
    wires: np.ndarray  # (outputs, most wires) of each cone
    sizes: np.ndarray  # (outputs, most wires) basis functions of each of them
    counts: np.ndarray  # (outputs,) wires in each cone
    bases: np.ndarray  # (n,) unit of frequency


@lru_cache(maxsize=64)
def interpolation(circuit: Circuit) -> Interpolation:
    """The grid of a circuit. TooLarge where cones or grid are."""
    found = find_cones(circuit)
    n = circuit.wires
    degree = [0] * n
    for cone in found.cones:
        for wire, value in zip(cone.wires, cone.degrees, strict=True):
            degree[wire] = max(degree[wire], value)
    colour = _colours(found, n)
    colours = max(colour, default=-1) + 1
    sizes = [max(2 * degree[wire] + 1 for wire in range(n) if colour[wire] == c) for c in range(colours)]
    most = max(cone.coefficients for cone in found.cones)
    if (entries := len(found.cones) * most * prod(sizes)) > MAX_ENTRIES:
        raise TooLarge(
            f"lightcone: ansatz {circuit.name} with {n} wires has an interpolation grid of {prod(sizes):,} points"
            f" and {readable_bytes(8 * entries)}; choose method=statevector or auto"
        )
    grid = np.stack(np.meshgrid(*(np.arange(size) for size in sizes), indexing="ij"), -1).reshape(-1, colours)
    bases = np.array([base or 1.0 for base in found.bases])
    turns = np.array(sizes)[colour] if colours else np.ones(n)
    points = (grid[:, colour] if colours else np.zeros((1, n))) * 2 * pi / turns / bases
    most_wires = max(len(cone.wires) for cone in found.cones)
    matrix = np.zeros((len(found.cones), most, len(points)))
    wires = np.zeros((len(found.cones), max(most_wires, 1)), dtype=np.int64)
    counts = np.ones_like(wires)
    for output, cone in enumerate(found.cones):
        rows = np.ones((1, len(points))) / len(points)
        for position, (wire, highest) in enumerate(zip(cone.wires, cone.degrees, strict=True)):
            angle = points[:, wire] * bases[wire]
            basis = [np.ones(len(points))]
            for k in range(1, highest + 1):
                basis += [2 * np.cos(k * angle), 2 * np.sin(k * angle)]
            rows = (rows[:, None, :] * np.stack(basis)[None]).reshape(-1, len(points))
            wires[output, position], counts[output, position] = wire, 2 * highest + 1
        matrix[output, : len(rows)] = rows
    number = np.array([len(cone.wires) for cone in found.cones])
    return Interpolation(found, points, matrix, max(degree), wires, counts, number, bases)


def _colours(cones: Cones, n: int) -> list[int]:
    """A colour for each wire such that no cone holds a colour twice; the fewest colours that a short search finds."""
    conflicts: list[set[int]] = [set() for _ in range(n)]
    for cone in cones.cones:
        for wire in cone.wires:
            conflicts[wire] |= set(cone.wires) - {wire}
    fewest = max((len(cone.wires) for cone in cones.cones), default=0)
    for colours in range(max(fewest, 1), n + 1):
        found = _colouring(conflicts, colours, [])
        if found:
            return found
    return list(range(n))


def _colouring(conflicts: list[set[int]], colours: int, chosen: list[int]) -> list[int] | None:
    wire = len(chosen)
    if wire == len(conflicts):
        return chosen
    for colour in range(min(colours, max(chosen, default=-1) + 2)):
        if all(chosen[other] != colour for other in conflicts[wire] if other < wire):
            found = _colouring(conflicts, colours, [*chosen, colour])
            if found:
                return found
    return None


class LightCone:
    """A circuit whose outputs have small cones, ready to run on the CPU. ValueError if they do not."""

    def __init__(self, circuit: Circuit) -> None:
        self.grid = interpolation(circuit)
        self.engine = Engine(compile_program(circuit))
        width = lanes(8)
        self.points = trigonometry(blocked(self.grid.points, width), self.engine.tape.scales)


def coefficients(circuit: Circuit, weights: Tensor) -> Tensor:
    """(outputs, most coefficients) of a circuit for stacked weights (rows, 3, n), differentiable."""
    grid = interpolation(circuit)
    points = torch.from_numpy(grid.points).to(weights.device, weights.dtype)
    values = statevector.evaluate(compile_program(circuit), points, weights)
    matrix = torch.from_numpy(grid.matrix).to(weights.device, weights.dtype)
    return torch.einsum("kcp,pk->kc", matrix, values)


def polynomials(circuit: Circuit, x: Tensor, table: Tensor) -> Tensor:
    """The polynomials (B, outputs) with those coefficients at inputs x (B, n): plain PyTorch."""
    grid = interpolation(circuit)
    waves = [statevector.waves(x, (order * grid.bases).tolist()) for order in range(1, grid.most + 1)]
    basis = torch.stack([torch.ones_like(x.T), *chain.from_iterable(waves)], -1)  # (n, B, 2 most + 1)
    outputs = []
    for k, cone in enumerate(grid.cones.cones):
        value = table[k, : cone.coefficients].expand(x.shape[0], -1)
        for wire, degree in zip(reversed(cone.wires), reversed(cone.degrees), strict=True):
            size = 2 * degree + 1
            value = (value.reshape(x.shape[0], value.shape[1] // size, size) * basis[wire, :, None, :size]).sum(-1)
        outputs.append(value.reshape(x.shape[0]))
    values = torch.stack(outputs, -1)
    return values + (values.clamp(-1, 1) - values).detach()


class _Polynomials(torch.autograd.Function):
    """Coefficients by the compiled engine, in float64; then the compiled polynomials."""

    @staticmethod
    def forward(ctx: Any, cone: LightCone, x: Tensor, weights: Tensor) -> Tensor:
        grid = cone.grid
        bound = cone.engine.bound(flat_weights(weights), np.float64)
        values, kept = bound.forward(cone.points)
        values = values.transpose(1, 0, 2).reshape(values.shape[1], -1, 1)[:, : len(grid.points)]
        dtype = numpy_dtype(x.dtype)
        table = np.matmul(grid.matrix, values)[..., 0].astype(dtype)
        angles = blocked(x.detach().numpy(), lanes(table.itemsize))
        trig = np.empty((angles.shape[0], 2, *angles.shape[1:]), dtype)
        waves(angles, grid.bases, trig.swapaxes(0, 1))
        out = np.empty((trig.shape[0], len(grid.counts), trig.shape[3]), dtype)
        parts = min(PARTS, max(trig.shape[0], 1))
        arguments = trig, trig.shape[3], grid.most, table, grid.wires, grid.sizes, grid.counts
        run(polynomial.evaluate, parts, parts, *arguments, out)
        ctx.saved = cone, bound, kept, parts, arguments
        ctx.shapes = x.shape[0], weights.shape, weights.dtype
        return unblocked(out, x.shape[0]).clamp_(-1, 1)  # rounding may lead beyond

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, Tensor, Tensor]:
        cone, bound, kept, parts, arguments = ctx.saved
        batch, shape, dtype = ctx.shapes
        grid, trig, table = cone.grid, arguments[0], arguments[3]
        width = trig.shape[3]
        inputs = np.empty((trig.shape[0], trig.shape[2], width), table.dtype)
        sums = np.empty((parts, *table.shape))
        run(polynomial.gradients, parts, parts, *arguments, blocked(gradient.detach().numpy(), width), inputs, sums)
        change = np.zeros((len(grid.counts), cone.points.shape[0] * cone.points.shape[-1]))
        change[:, : len(grid.points)] = np.matmul(sums.sum(0)[:, None], grid.matrix)[:, 0]
        change = change.reshape(len(change), -1, cone.points.shape[-1]).transpose(1, 0, 2)
        _, weights = bound.backward(cone.points, kept, np.ascontiguousarray(change))
        inputs *= grid.bases[:, None].astype(table.dtype)
        dx = unblocked(inputs, batch)
        return None, dx, torch.from_numpy(weights).to(dtype).reshape(shape)


def evaluate(cone: LightCone, x: Tensor, weights: Tensor) -> Tensor:
    """Expectation values (B, outputs) for inputs x (B, n) in radians and stacked weights (rows, 3, n), on the CPU."""
    return _Polynomials.apply(cone, x, weights)


def evaluate_reference(circuit: Circuit, x: Tensor, weights: Tensor) -> Tensor:
    """The same in plain PyTorch, on any device."""
    return polynomials(circuit, x, coefficients(circuit, weights))
