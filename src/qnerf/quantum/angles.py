"""The angles of a program, in PyTorch: many expressions at once, differentiable to any order."""

from collections.abc import Sequence
from math import pi, prod

import numpy as np
import torch
from torch import Tensor

from qnerf.quantum.basis import placed
from qnerf.quantum.blocks import Diagonal, Turn, rotations_of
from qnerf.quantum.expressions import Expression
from qnerf.quantum.one_wire import Factors
from qnerf.quantum.program import PRODUCTS, Program
from qnerf.quantum.words import Word


def offsets(parameters: dict[str, tuple[int, ...]]) -> dict[str, int]:
    """Where each parameter begins in the flat weights."""
    where, first = {}, 0
    for name, shape in parameters.items():
        where[name] = first
        first += prod(shape)
    return where


class ExpressionTable:
    """The values (B, E) of E expressions. Sums are float64, whatever the weights and inputs are.

    Expressions without features give (1, E) if `fixed`, else every value is of one sample.
    """

    def __init__(self, expressions: Sequence[Expression], parameters: dict[str, tuple[int, ...]], fixed: bool) -> None:
        first = offsets(parameters)
        terms = [(row, *term) for row, expression in enumerate(expressions) for term in expression.terms]
        self.size, self.fixed = len(expressions), fixed
        rows = [row for row, *_ in terms]
        self.in_order = rows == list(range(self.size))  # one term each
        # Factor k of every term; the place behind the last weight or feature stands for the number 1.
        count = sum(map(prod, parameters.values()))
        of_weights = _padded([[first[name] + index for name, index in weights] for _, _, weights, _ in terms], count)
        of_features = _padded([list(features) for *_, features in terms], -1)
        self.takes_one = any(count in each for each in of_weights)
        # Arrays, because a tensor that is made inside a mode of PyTorch, such as that of torch.export, keeps it.
        self.rows = np.array(rows, dtype=np.int64)
        self.of_weights, self.of_features = (list(np.array(each, np.int64)) for each in (of_weights, of_features))
        self.numbers = np.array([number for _, number, _, _ in terms], dtype=np.float64)
        self.is_sum = bool((self.numbers == 1).all())

    def __call__(self, x: Tensor, weights: Tensor) -> Tensor:
        """Values for inputs x (B, features) and flat weights."""
        # Every call of PyTorch counts: a step of a small batch takes no longer than two dozen of them.
        factors = weights.double()
        if self.takes_one:
            factors = torch.cat([factors, factors.new_ones(1)])
        values = None if self.is_sum and len(self.of_weights) else _tensor(self.numbers, weights.device)
        for index in self.of_weights:
            found = factors.index_select(0, _tensor(index, weights.device))
            values = found if values is None else values * found
        assert values is not None
        values = values[None]
        if not self.fixed:
            inputs = torch.cat([x.double(), x.new_ones(x.shape[0], 1, dtype=torch.float64)], 1)
            if not len(self.of_features):
                values = values.expand(x.shape[0], -1)
            for index in self.of_features:
                values = values * inputs[:, _tensor(index, weights.device)]
        if self.in_order:
            return values
        rows = _tensor(self.rows, weights.device)
        return values.new_zeros(values.shape[0], self.size).index_add(1, rows, values)


def _tensor(array: np.ndarray, device: torch.device) -> Tensor:
    if array.size:
        return placed(array, device)
    return torch.empty(array.shape, dtype=torch.float64 if array.dtype.kind == "f" else torch.int64, device=device)


def _padded(rows: list[list[int]], end: int) -> list[list[int]]:
    """Lists of indices -> for each position the index in every list, `end` past its end."""
    longest = max(map(len, rows), default=0)
    return [[row[k] if k < len(row) else end for row in rows] for k in range(longest)]


class Inputs:
    """What angles that depend on the input are made of: angle m is factors[m] times column columns[m] of the inputs.

    Where every angle is a number times one feature, the inputs are the features as they are. Else they are the values
    of the angles, in float64.
    """

    def __init__(self, angles: Sequence[Expression], parameters: dict[str, tuple[int, ...]]) -> None:
        terms = [angle.terms[0] for angle in angles if len(angle.terms) == 1]
        self.table: ExpressionTable | None = None
        self.columns, self.factors = list(range(len(angles))), [1.0] * len(angles)
        if len(terms) == len(angles) and all(not weights and len(features) == 1 for _, weights, features in terms):
            self.columns = [features[0] for *_, features in terms]
            self.factors = [factor for factor, *_ in terms]
        else:
            self.table = ExpressionTable(angles, parameters, fixed=False)

    def __call__(self, x: Tensor, weights: Tensor) -> Tensor:
        """(B, inputs) from inputs x (B, features) of the circuit and flat weights."""
        return x if self.table is None else self.table(x, weights)


_LEFT = np.array([
    [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 0, -1], [0, 0, 1, 0]],
    [[0, 0, -1, 0], [0, 0, 0, 1], [1, 0, 0, 0], [0, -1, 0, 0]],
    [[0, 0, 0, -1], [0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 0]],
], dtype=np.float64)  # fmt: skip
"""-iX, -iY and -iZ on the left of w - i(x X + y Y + z Z), as matrices on (w, x, y, z)."""


LEAST = 0.1  # of |sin theta|, for angles of Euler to have derivatives: rounding grows by its inverse
TINY = 1e-300  # in place of a xi of 0 that has derivatives


class Products:
    """Products of rotations of one wire as RZ(omega) RY(theta) RX(xi) RZ(phi), up to a sign.

    Where theta is a multiple of pi, phi and omega are one angle, and their derivatives would not exist. Near there
    (`LEAST`) omega is a number without derivatives; the other three have some of all orders. Those of xi are not zero
    then, and its value is TINY. Else xi is 0, without derivatives.
    """

    def __init__(self, products: Sequence[Factors], parameters: dict[str, tuple[int, ...]]) -> None:
        longest = max(map(len, products))
        factors = [(*own, *[(Word(0, 1, 0), Expression())] * (longest - len(own))) for own in products]
        self.table = ExpressionTable([angle for own in factors for _, angle in own], parameters, fixed=True)
        self.left = np.array([[_LEFT[0 if not word.z else 1 if word.x else 2] for word, _ in own] for own in factors])

    def __call__(self, x: Tensor, weights: Tensor) -> Tensor:
        """phi, theta, xi and omega of each product, flat, float64."""
        left = placed(self.left, weights.device)
        half = self.table(x, weights).reshape(*left.shape[:2], 1, 1) / 2
        steps = half.cos() * torch.eye(4, dtype=left.dtype, device=left.device) + half.sin() * left
        product = steps[:, 0, :, :1]
        for place in range(1, steps.shape[1]):
            product = steps[:, place] @ product
        product = product[..., 0]
        w, x_, y, z = product.unbind(1)
        regular = ((w.square() + z.square()) * (x_.square() + y.square()) > LEAST**2 / 4).detach()
        harmless = torch.where(regular[:, None], product, torch.ones_like(product))  # no derivative is infinite
        omega = torch.where(regular, _omega(harmless), _omega(product.detach()))
        c, s = (omega / 2).cos(), (omega / 2).sin()
        w, x_, y, z = c * w + s * z, c * x_ + s * y, c * y - s * x_, c * z - s * w
        phi = torch.atan2(2 * (w * z + x_ * y), w * w + y * y - x_ * x_ - z * z)
        theta = torch.atan2(2 * (w * y + x_ * z), w * w + z * z - x_ * x_ - y * y)
        xi = torch.asin(2 * (w * x_ - y * z))
        xi = torch.where(regular, torch.zeros_like(xi), xi - xi.detach() + TINY)
        return torch.stack([phi, theta, xi, omega], 1).flatten()


def _omega(product: Tensor) -> Tensor:
    """The last angle of Euler of products (..., 4)."""
    w, x, y, z = product.unbind(1)
    return torch.atan2(z, w) + torch.atan2(-x, y)


class Angles:
    """The angles of a program: the different ones, and which of them each rotation has.

    Attributes:
        rotations: for each block, its rotations as (word, fixed, moving): the numbers of a fixed angle and of one that
            moves with the input, whose sum is the angle; -1 for none. The constants of diagonals are `phases`.
        phases: for each block, the constant phases (2^n,) of a diagonal, complex128; None where there are none.
    """

    def __init__(self, program: Program) -> None:
        parameters = program.circuit.parameters
        fixed: dict[Expression, int] = {}
        moving: dict[Expression, int] = {}
        self.rotations: list[list[tuple[Word, int, int]]] = []
        self.phases: list[np.ndarray | None] = []
        for block in program.blocks:
            rows = []
            constants: dict[int, float] = {}
            for word, angle in rotations_of(block, program.wires):
                still, moved = (Expression(), angle) if isinstance(block, Turn) and angle.features else angle.parts()
                if isinstance(block, Diagonal):
                    constant, still = still.split_constant()
                    if constant:
                        constants[word.z] = constant
                rows.append((
                    word,
                    fixed.setdefault(still, len(fixed)) if still.terms else -1,
                    moving.setdefault(moved, len(moving)) if moved.terms else -1,
                ))  # fmt: skip
            self.rotations.append(rows)
            self.phases.append(constant_phases(constants, program.wires) if constants else None)
        products = program.products
        self._products = Products(products, parameters) if products else None
        self._fixed = ExpressionTable(list(fixed), parameters | {PRODUCTS: (4 * len(products),)}, fixed=True)
        self.inputs = Inputs(list(moving), parameters)
        used = [*fixed, *moving, *(Expression.of(value) for part in program.start for value in part.angles)]
        self.takes_all = (
            bool(program.words or program.outcomes)
            and any(angle.features for angle in used)
            and any(angle.weights for angle in used)
        )

    def fixed(self, x: Tensor, weights: Tensor) -> Tensor:
        """The fixed angles (1, F) for flat weights."""
        if self._products is not None:
            weights = torch.cat([weights.double(), self._products(x, weights)])
        return self._fixed(x, weights)


def constant_phases(angles: dict[int, float], wires: int) -> np.ndarray:
    """(2^n,) exp(-i/2 sum_m angles[m] z_m), complex128, for products of Z on the wires of each mask m.

    The phase of |0...0> is 1, and multiples of pi/4 are exact: the phases of CZ are 1 and -1.
    """
    basis = np.arange(2**wires)
    total = np.zeros(2**wires)
    for mask, angle in angles.items():
        total += angle * (np.bitwise_count(basis & mask) & 1)  # less the phase of |0...0>
    turns = total / (pi / 4)
    near = np.rint(turns)
    total = np.where(np.abs(turns - near) < 1e-9, near % 8, turns) * (pi / 4)
    phases = np.exp(1j * total)
    snapped = np.where(np.abs(phases.real) < 1e-15, 1j * phases.imag, phases)
    out: np.ndarray = np.where(np.abs(phases.imag) < 1e-15, phases.real + 0j, snapped)
    return out
