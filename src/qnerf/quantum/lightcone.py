"""The light-cone engine: every value as an explicit trigonometric polynomial of the few inputs it depends on.

With S = 1 a value of QIREN depends on three inputs, whatever the number of wires: 27 coefficients, computed once a
step. They come from interpolation. The circuit is evaluated exactly on a grid of equispaced angles, and a discrete
Fourier transform of those values gives the coefficients without error. Features that share no cone can take the same
grid angle. They are found by colouring, so that 8 features need 81 evaluations, not 216. Any circuit with small cones
will do. A wide one is several smaller ones (`registers`).
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import chain
from math import pi, prod
from typing import Any

import numpy as np
import torch
from torch import Tensor

from qnerf.kernels.derivatives import is_differentiated, through_reference
from qnerf.kernels.jit import run
from qnerf.kernels.simd import lanes
from qnerf.quantum.basis import placed
from qnerf.quantum.circuit import readable_bytes
from qnerf.quantum.compiled import polynomial
from qnerf.quantum.compiled.engine import PARTS, cos_sin, from_blocks, to_blocks
from qnerf.quantum.cones import Cones, TooLarge
from qnerf.quantum.statevector import PlainCircuit, Simulate, clipped
from qnerf.quantum.statevector import cos_sin as plain_cos_sin

MAX_ENTRIES = 2**22  # of the interpolation matrix: 32 MiB


@dataclass(frozen=True)
class PolynomialForm:
    """Which polynomials the values of a circuit are.

    Attributes:
        cones: of the circuit; the coefficients of value k are ordered as `cones.cones[k]` is.
        highest_degree: of any feature.
        used: the features that are in any cone.
        features: (values, most features) of each cone, as places in `used`.
        basis_sizes: (values, most features) number of basis functions 1, cos, sin, ... of each of these features.
        counts: (values,) features in each cone.
        base_frequencies: (features,).
    """

    cones: Cones
    highest_degree: int
    used: np.ndarray
    features: np.ndarray
    basis_sizes: np.ndarray
    counts: np.ndarray
    base_frequencies: np.ndarray

    @cached_property
    def uses_all(self) -> bool:
        """Whether every feature is in a cone."""
        return len(self.used) == len(self.base_frequencies)


@dataclass(frozen=True)
class Interpolation:
    """Where to evaluate a circuit, and how to turn the values into coefficients.

    Attributes:
        points: (points, features) inputs in radians.
        matrix: (values, most coefficients, points); coefficients = matrix @ values. Unused rows at the end are 0.
    """

    points: np.ndarray
    matrix: np.ndarray


@lru_cache(maxsize=64)
def polynomial_form(cones: Cones) -> PolynomialForm:
    """The polynomials of a circuit with these cones."""
    used = sorted({feature for cone in cones.cones for feature in cone.features})
    features = np.zeros((len(cones.cones), max([1, *(len(cone.features) for cone in cones.cones)])), dtype=np.int64)
    basis_sizes = np.ones_like(features)
    for value, cone in enumerate(cones.cones):
        for position, (feature, highest) in enumerate(zip(cone.features, cone.degrees, strict=True)):
            features[value, position], basis_sizes[value, position] = used.index(feature), 2 * highest + 1
    counts = np.array([len(cone.features) for cone in cones.cones])
    base = np.array([frequency or 1.0 for frequency in cones.base_frequencies])
    highest = int(basis_sizes.max()) // 2
    return PolynomialForm(cones, highest, np.array(used, dtype=np.int64), features, basis_sizes, counts, base)


@lru_cache(maxsize=64)
def interpolation(cones: Cones) -> Interpolation:
    """The interpolation grid of a circuit with these cones.

    Raises:
        TooLarge: the grid is too large.
    """
    n = len(cones.base_frequencies)
    degree = [0] * n
    for cone in cones.cones:
        for feature, value in zip(cone.features, cone.degrees, strict=True):
            degree[feature] = max(degree[feature], value)
    colour = _colours(cones, n)
    colours = max(colour, default=-1) + 1
    sizes = [max(2 * degree[k] + 1 for k in range(n) if colour[k] == c) for c in range(colours)]
    most_coefficients = max(cone.coefficients for cone in cones.cones)
    if (entries := len(cones.cones) * most_coefficients * prod(sizes)) > MAX_ENTRIES:
        raise TooLarge(
            f"lightcone: circuit {cones.name} has an interpolation grid of {prod(sizes):,} points"
            f" and {readable_bytes(8 * entries)}; choose method=statevector or auto"
        )
    grid = np.stack(np.meshgrid(*(np.arange(size) for size in sizes), indexing="ij"), -1).reshape(-1, colours)
    base = np.array([frequency or 1.0 for frequency in cones.base_frequencies])
    grid_sizes = np.array(sizes)[colour] if colours else np.ones(n)
    points = (grid[:, colour] if colours else np.zeros((1, n))) * 2 * pi / grid_sizes / base
    matrix = np.zeros((len(cones.cones), most_coefficients, len(points)))
    for value, cone in enumerate(cones.cones):
        rows = np.ones((1, len(points))) / len(points)
        for feature, highest in zip(cone.features, cone.degrees, strict=True):
            angle = points[:, feature] * base[feature]
            basis = [np.ones(len(points))]
            for k in range(1, highest + 1):
                basis += [2 * np.cos(k * angle), 2 * np.sin(k * angle)]
            rows = (rows[:, None, :] * np.stack(basis)[None]).reshape(-1, len(points))
        matrix[value, : len(rows)] = rows
    return Interpolation(points, matrix)


def _colours(cones: Cones, n: int) -> list[int]:
    """A colour for each feature such that no cone holds a colour twice, with the fewest colours."""
    conflicts: list[set[int]] = [set() for _ in range(n)]
    for cone in cones.cones:
        for feature in cone.features:
            conflicts[feature] |= set(cone.features) - {feature}
    fewest = max((len(cone.features) for cone in cones.cones), default=0)
    for colours in range(max(fewest, 1), n + 1):
        colouring = _extended(conflicts, colours, [])
        if colouring:
            return colouring
    return list(range(n))


def _extended(conflicts: list[set[int]], colours: int, chosen: list[int]) -> list[int] | None:
    """The colours chosen so far, completed to all features by backtracking; None if that is impossible."""
    feature = len(chosen)
    if feature == len(conflicts):
        return chosen
    for colour in range(min(colours, max(chosen, default=-1) + 2)):
        if all(chosen[other] != colour for other in conflicts[feature] if other < feature):
            colouring = _extended(conflicts, colours, [*chosen, colour])
            if colouring:
                return colouring
    return None


class LightCones:
    """The polynomials of a circuit, from its values on a grid.

    Raises:
        TooLarge: the circuit has no small light cones.
    """

    def __init__(self, cones: Cones) -> None:
        self.form, self.grid = polynomial_form(cones), interpolation(cones)

    def on_grid(
        self, plain: PlainCircuit, simulate: Simulate, weights: Tensor, fixed: Tensor, start: Tensor | None
    ) -> Tensor:
        """The values (points, values) that `simulate` gives on the grid, float64."""
        points = placed(self.grid.points, weights.device)
        return simulate(fixed, plain.angles.inputs(points, weights), start, len(points), torch.float64)

    def coefficients(self, values: Tensor) -> Tensor:
        """Coefficients (values, most coefficients) of the polynomials with these values (points, values)."""
        return (placed(self.grid.matrix, values.device, values.dtype) * values.T[:, None]).sum(2)

    def through(self, x: Tensor, values: Tensor) -> Tensor:
        """The polynomials with these values on the grid, at inputs x (B, features): plain PyTorch."""
        return polynomials(self.form, x, self.coefficients(values).to(x.dtype))

    def evaluate(self, plain: PlainCircuit, simulate: Simulate, x: Tensor, weights: Tensor, compiled: bool) -> Tensor:
        """Outputs (B, outputs) of the circuit, by polynomials whose coefficients come from `simulate`."""

        def values(fixed: Tensor, _: Tensor, start: Tensor | None, batch: int, dtype: torch.dtype) -> Tensor:
            found = self.on_grid(plain, simulate, weights, fixed, start)
            if not compiled:
                return self.through(x, found)
            out: Tensor = _Polynomials.apply(self, x, found)
            return out

        return plain.evaluate(x, weights, values)


def polynomials(form: PolynomialForm, x: Tensor, coefficients: Tensor) -> Tensor:
    """The polynomials (B, values) with those coefficients at inputs x (B, features): plain PyTorch."""
    waves = [plain_cos_sin(x, (order * form.base_frequencies).tolist()) for order in range(1, form.highest_degree + 1)]
    basis = torch.stack([torch.ones_like(x.T), *chain.from_iterable(waves)], -1)  # (features, B, 2 highest_degree + 1)
    values = []
    for k, cone in enumerate(form.cones.cones):
        value = coefficients[k, : cone.coefficients].expand(x.shape[0], -1)
        for feature, degree in zip(reversed(cone.features), reversed(cone.degrees), strict=True):
            size = 2 * degree + 1
            value = (value.reshape(x.shape[0], value.shape[1] // size, size) * basis[feature, :, None, :size]).sum(-1)
        values.append(value.reshape(x.shape[0]))
    return clipped(torch.stack(values, -1))


class _Polynomials(torch.autograd.Function):
    """`LightCones.through`, compiled."""

    @staticmethod
    def forward(ctx: Any, cones: LightCones, x: Tensor, values: Tensor) -> Tensor:
        form, own = cones.form, x.detach().numpy()
        table = np.matmul(cones.grid.matrix, values.detach().numpy().T[..., None])[..., 0].astype(own.dtype)
        angles = to_blocks(own if form.uses_all else own[:, form.used], lanes(table.itemsize))
        trig = np.empty((angles.shape[0], 2, *angles.shape[1:]), table.dtype)
        cos_sin(angles, form.base_frequencies[form.used], trig.swapaxes(0, 1))
        out = np.empty((trig.shape[0], len(form.counts), trig.shape[3]), table.dtype)
        parts = min(PARTS, max(len(trig), 1))
        found = polynomial.Polynomials(form.highest_degree, table, form.features, form.basis_sizes, form.counts)
        arguments = trig, trig.shape[3], found
        run(polynomial.evaluate, parts, parts, *arguments, out)
        ctx.save_for_backward(x, values)
        ctx.saved = cones, parts, arguments
        # Rounding may lead beyond. PyTorch would share this with threads, which then spin beside the loops.
        return from_blocks(np.clip(out, -1, 1, out=out), x.shape[0])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        cones, parts, arguments = ctx.saved
        if is_differentiated(gradient):
            return None, *through_reference(cones.through, ctx.saved_tensors, gradient)
        form, x, (trig, width, found) = cones.form, ctx.saved_tensors[0], arguments
        inputs = np.empty((trig.shape[0], trig.shape[2], width), trig.dtype)
        sums = np.empty((parts, *found.coefficients.shape))
        upstream = to_blocks(gradient.detach().resolve_neg().numpy(), width)
        run(polynomial.gradients, parts, parts, *arguments, upstream, inputs, sums)
        inputs *= form.base_frequencies[form.used][:, None].astype(trig.dtype)
        dx = from_blocks(inputs, len(x))
        if not form.uses_all:
            dx = torch.zeros_like(x).index_copy_(1, torch.from_numpy(form.used), dx)
        return None, dx, torch.from_numpy(np.matmul(sums.sum(0)[:, None], cones.grid.matrix)[:, 0].T)
