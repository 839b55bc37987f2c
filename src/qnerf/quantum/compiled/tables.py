"""From weights to the tables that the compiled engine reads: tangents, diagonals, signs. Once a step, in float64.

A circuit becomes `CircuitArrays` once. `bind_weights` then turns the weights of a step, (rows, n, 3), into `Tables`.

RY layers run with tangents (`forward_passes.ry_layer`). To keep |tan| <= 1, RY(angle) = Y^k RY(angle - k pi) up to a
phase, with |angle - k pi| <= pi/2. The Y's are never applied. They are carried through the circuit as a Pauli frame, a
product X^x Z^z on each wire in front of the state. The frame flips bits in the diagonals that follow, flips signs of
angles (of an RY angle where x + z is odd), and in the end flips the signs of <Z> and <X>.
"""

from dataclasses import dataclass
from functools import cached_property
from math import cos, sin
from typing import Any, NamedTuple

import numpy as np

from qnerf.kernels.jit import jit
from qnerf.kernels.simd import inner
from qnerf.quantum.normal_form import (
    CNOTs,
    Diagonal,
    NormalForm,
    Step,
    cnot_permutation,
    cz_signs,
    z_eigenvalues,
)

DIAGONAL, RY, PERMUTATION, START = range(4)

Operation = tuple[int, int, int, int]
"""Code, step, row of `encoding_scales` or -1, permutation or -1."""


class Steps(NamedTuple):
    """The steps of a normal form, without the weights. Compiled loops take it as it is."""

    codes: Any  # (steps,) DIAGONAL, RY or PERMUTATION
    weight_ranges: Any  # (steps + 1,) where the weights of each step begin in `weights`
    weights: Any  # (uses, 2) row and kind of each weight: weights[row, :, kind] is added to the angles of the step
    constants: Any  # (steps, n) radians
    cz_signs: Any  # (steps, 2^n) diagonals of the CZs
    cnots: Any  # (pairs, 3) step, control and target of each CNOT


class Tables(NamedTuple):
    """What a step needs of the weights. Compiled loops take it as it is."""

    tangents: Any  # (steps, n) of half the angles of RY layers
    diagonals: Any  # (steps, 2, 2^n) real and imaginary parts, times the cosines of the RY layer that follows
    flip_masks: Any  # (steps,) bits that the Pauli frame flips
    angle_signs: Any  # (steps, n) signs that the Pauli frame gives the angles
    permutations: Any  # (permutations, 2^n) of the CNOTs, whatever the weights are


class Measurement(NamedTuple):
    """What is measured. Compiled loops take it as it is."""

    measures_last_layer: Any  # whether <Z> and <X> before the last RY layer are measured instead of <Z> after it
    wires: Any  # (outputs,) the measured wire, where each output has one
    eigenvalues: Any  # (outputs, 2^n) of the measured products of Z
    last_layer: Any  # (4, n) factors of <Z> and <X> before the last RY layer, and their derivatives by its angle


@dataclass(frozen=True)
class CircuitArrays:
    """A normal form as arrays. The weights are not in them.

    Attributes:
        form: the normal form.
        once: (operations, 4) on |0...0>, once for a batch.
        per_sample: (operations, 4) on every sample.
        steps: all of these steps, and the last RY layer if it is part of the measurement.
        input_scales: (steps, n) the input's factor in each step's angles.
        encoding_scales: (encodings, n) the rows of `input_scales` that differ and are not 0.
        permutations: (permutations, 2^n).
        wires: (outputs,) the measured wire, where each output has one.
        eigenvalues: (outputs, 2^n) of the measured products of Z.
    """

    form: NormalForm
    once: np.ndarray
    per_sample: np.ndarray
    steps: Steps
    input_scales: np.ndarray
    encoding_scales: np.ndarray
    permutations: np.ndarray
    wires: np.ndarray
    eigenvalues: np.ndarray

    @cached_property
    def stored_states(self) -> int:
        """States that the backward pass stores: the first one, and one before every operation but diagonals."""
        return 1 + int((self.per_sample[:, 0] != DIAGONAL).sum())


class _Builder:
    """Collects the operations and the steps of a normal form, in order."""

    def __init__(self, form: NormalForm) -> None:
        self.form = form
        self.steps: list[Step] = []
        self.codes: list[int] = []
        self.once: list[Operation] = [(START, -1, -1, -1)]
        self.per_sample: list[Operation] = []
        self.encoding_scales: list[tuple[float, ...]] = []
        self.permutations: list[np.ndarray] = []
        self.cnots: list[tuple[int, int, int]] = []
        for index, step in enumerate(form.steps[:-1] if form.measures_last_layer else form.steps):
            self.add_step(index, step)
        if not self.per_sample:
            self.per_sample.append((START, -1, -1, -1))
        if form.measures_last_layer:
            self.steps.append(form.steps[-1])
            self.codes.append(RY)

    def add_step(self, index: int, step: Step) -> None:
        operations = self.once if index < self.form.fixed_steps else self.per_sample
        if isinstance(step, CNOTs):
            self.cnots.extend((len(self.steps), control, target) for control, target in step.pairs)
            self.permutations.append(cnot_permutation(step.pairs, self.form.wires))
            self.add(operations, PERMUTATION, step, permutation=len(self.permutations) - 1)
        elif isinstance(step, Diagonal):
            self.add(operations, START if index == self.form.fixed_steps else DIAGONAL, step, self.encoding(step))
        else:
            if operations[-1][0] not in (START, DIAGONAL):
                self.add(operations, DIAGONAL, Diagonal())  # it takes the cosines
            self.add(operations, RY, step)

    def encoding(self, step: Diagonal) -> int:
        """The row of the step's scales in `encoding_scales`; -1 where it holds no input."""
        if step.angles.scales is None:
            return -1
        if step.angles.scales not in self.encoding_scales:
            self.encoding_scales.append(step.angles.scales)
        return self.encoding_scales.index(step.angles.scales)

    def add(
        self, operations: list[Operation], code: int, step: Step, encoding: int = -1, permutation: int = -1
    ) -> None:
        operations.append((code, len(self.steps), encoding, permutation))
        self.steps.append(step)
        self.codes.append(DIAGONAL if isinstance(step, Diagonal) else code)


def circuit_arrays(form: NormalForm) -> CircuitArrays:
    """The arrays of a normal form."""
    n, found = form.wires, _Builder(form)
    weights: list[tuple[int, int]] = []
    weight_ranges = [0]
    constants, input_scales = np.zeros((len(found.steps), n)), np.zeros((len(found.steps), n))
    signs = np.ones((len(found.steps), 2**n), dtype=np.float32)
    for index, step in enumerate(found.steps):
        if not isinstance(step, CNOTs):
            weights.extend(step.angles.weights)
            constants[index] += step.angles.constant or 0.0
            input_scales[index] += step.angles.scales or 0.0
            if isinstance(step, Diagonal):
                signs[index] = cz_signs(step.pairs, n)
        weight_ranges.append(len(weights))

    def integers(rows: list[Any], *columns: int) -> np.ndarray:
        return np.array(rows, dtype=np.int64).reshape(len(rows), *columns)

    return CircuitArrays(
        form=form,
        once=integers(found.once, 4),
        per_sample=integers(found.per_sample, 4),
        steps=Steps(
            integers(found.codes), integers(weight_ranges), integers(weights, 2), constants, signs,
            integers(found.cnots, 3),
        ),
        input_scales=input_scales,
        encoding_scales=np.array(found.encoding_scales, dtype=np.float64).reshape(len(found.encoding_scales), n),
        permutations=integers(found.permutations, 2**n),
        wires=integers([min(product, default=0) for product in form.measured]),
        eigenvalues=z_eigenvalues(form.measured, n),
    )  # fmt: skip


# Loops rather than expressions of whole arrays: for their checks of shapes Numba compiles its functions of strings,
# which takes longer than all that is here.
@inner
def _fixed_angles(steps: Steps, step: int, weights: Any, total: Any) -> None:
    """Fills `total` (n,): the angles of a step without the input's part."""
    for j in range(len(total)):
        total[j] = steps.constants[step, j]
        for e in range(steps.weight_ranges[step], steps.weight_ranges[step + 1]):
            total[j] += weights[steps.weights[e, 0], j, steps.weights[e, 1]]


@inner
def _bit_mask(x: Any) -> int:
    """The bits that X^x flips in the number of a basis state."""
    mask = 0
    for j in range(len(x)):
        mask |= int(x[j]) << (len(x) - 1 - j)
    return mask


@inner
def _bind_diagonal(step: int, angle: Any, x: Any, mask: int, signs: Any, tables: Tables) -> None:
    """The phases of all basis states, wire by wire: each phase of j wires becomes two phases of j + 1 wires."""
    table = tables.diagonals[step]
    table[0, 0], table[1, 0] = 1.0, 0.0
    for j in range(len(angle)):
        sign = -1.0 if x[j] else 1.0
        tables.angle_signs[step, j] = sign
        c, s = cos(angle[j] / 2), sign * sin(angle[j] / 2)
        # From the last state to the first, so that no phase is overwritten before it was read.
        for k in range((1 << j) - 1, -1, -1):
            a, b = table[0, k], table[1, k]
            table[0, 2 * k], table[1, 2 * k] = a * c + b * s, b * c - a * s
            table[0, 2 * k + 1], table[1, 2 * k + 1] = a * c - b * s, b * c + a * s
    for b in range(1 << len(angle)):
        table[0, b] *= signs[b ^ mask]
        table[1, b] *= signs[b ^ mask]


@inner
def _bind_ry(step: int, angle: Any, x: Any, z: Any, tables: Tables) -> float:
    """The tangents of half angles, and the Y's that enter the frame; returns the product of the cosines."""
    scale = 1.0
    for j in range(len(angle)):
        sign = -1.0 if x[j] != z[j] else 1.0
        tables.angle_signs[step, j] = sign
        c, s = cos(angle[j] / 2), sin(angle[j] / 2)
        if abs(s) > abs(c):  # k is odd; no digit of a large angle is lost to multiples of pi
            c, s = s, -c
            x[j], z[j] = not x[j], not z[j]
        tables.tangents[step, j] = sign * s / c
        scale *= abs(c)
    return scale


@inner
def _bind_last_layer(step: int, angle: Any, x: Any, z: Any, tables: Tables, last_layer: Any) -> None:
    """<Z> after the last RY layer is cos <Z> - sin <X> before it; the frame flips the signs of both."""
    for j in range(len(angle)):
        tables.angle_signs[step, j] = 1.0
        zs, xs = -1.0 if x[j] else 1.0, -1.0 if z[j] else 1.0
        last_layer[0, j], last_layer[1, j] = zs * cos(angle[j]), -xs * sin(angle[j])
        last_layer[2, j], last_layer[3, j] = -zs * sin(angle[j]), -xs * cos(angle[j])


@inner
def _carry_frame(step: int, cnots: Any, x: Any, z: Any) -> None:
    """The Pauli frame behind the CNOTs of a step: X spreads to the target, Z to the control."""
    for p in range(len(cnots)):
        if cnots[p, 0] == step:
            control, target = cnots[p, 1], cnots[p, 2]
            x[target] = x[target] != x[control]
            z[control] = z[control] != z[target]


@jit
def bind_weights(steps: Steps, weights: Any, measurement: Measurement, tables: Tables, flipped: Any) -> float:
    """Fills `tables`, `measurement.last_layer` and `flipped`; returns the amplitude of |0...0> to start from.

    weights (rows, n, 3): phi, theta and omega of every wire, radians
    flipped (outputs, 2^n): `measurement.eigenvalues` behind the Pauli frame
    """
    n = steps.constants.shape[1]
    x, z = np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)  # the Pauli frame
    angle = np.empty(n)
    amplitude = 1.0
    last = len(steps.codes) - 1 if measurement.measures_last_layer else len(steps.codes)
    # The steps in order, because each of them may change the frame of all that follow.
    for step in range(len(steps.codes)):
        _fixed_angles(steps, step, weights, angle)
        mask = _bit_mask(x)
        tables.flip_masks[step] = mask
        if step == last:
            _bind_last_layer(step, angle, x, z, tables, measurement.last_layer)
        elif steps.codes[step] == DIAGONAL:
            _bind_diagonal(step, angle, x, mask, steps.cz_signs[step], tables)
        elif steps.codes[step] == RY:
            scale = _bind_ry(step, angle, x, z, tables)
            # The cosines that a layer of tangents lacks go into the diagonal before it, or else into the start.
            if step > 0 and steps.codes[step - 1] == DIAGONAL:
                for b in range(1 << n):
                    tables.diagonals[step - 1, 0, b] *= scale
                    tables.diagonals[step - 1, 1, b] *= scale
            else:
                amplitude *= scale
        else:
            _carry_frame(step, steps.cnots, x, z)
    # What is left of the frame at the end flips bits of what is measured.
    mask = _bit_mask(x)
    for k in range(len(flipped)):
        for b in range(1 << n):
            flipped[k, b] = measurement.eigenvalues[k, b ^ mask]
    return amplitude


@jit
def add_weight_gradients(steps: Steps, angle_signs: Any, sums: Any, gradient: Any) -> None:
    """Adds the gradients of the angles, `sums` (steps, n), to `gradient` (rows, n, 3) of the weights."""
    for step in range(len(angle_signs)):
        for e in range(steps.weight_ranges[step], steps.weight_ranges[step + 1]):
            for j in range(sums.shape[1]):
                gradient[steps.weights[e, 0], j, steps.weights[e, 1]] += angle_signs[step, j] * sums[step, j]
