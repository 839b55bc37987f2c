"""From weights to the tables that the compiled engine reads: tangents, diagonals, signs. Once a step, in float64.

RY layers run with tangents (`forward_passes.ry_layer`). To keep |tan| <= 1, RY(angle) = Y^k RY(angle - k pi) up to a
phase, with |angle - k pi| <= pi/2. The Y's are never applied. They are carried through the circuit as a Pauli frame, a
product X^x Z^z on each wire in front of the state. The frame flips bits in the diagonals that follow, flips signs of
angles (of an RY angle where x + z is odd), and in the end flips the signs of <Z> and <X>.
"""

from dataclasses import dataclass
from functools import cached_property
from math import cos, sin
from typing import Any

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

DIAGONAL, RY, RY_PER_SAMPLE, PERMUTATION, START = range(5)

Operation = tuple[int, int, int, int]
"""Code, step, row of `encoding_scales` or -1, permutation or -1."""


@dataclass(frozen=True)
class CircuitArrays:
    """A normal form as arrays. The weights are not in them.

    Attributes:
        form: the normal form.
        once: (operations, 4) on |0...0>, once for a batch.
        per_sample: (operations, 4) on every sample.
        codes: (steps,) of all of these steps, and of the last RY layer if it is part of the measurement.
        weight_ranges: (steps + 1,) the range of each step in `weight_rows`.
        weight_rows: rows row * 3 + kind of the flat weights (rows * 3, n).
        constants: (steps, n) radians.
        input_scales: (steps, n) the input's factor in each step's angles.
        encoding_scales: (encodings, n) the rows of `input_scales` that differ and are not 0.
        cz_signs: (steps, 2^n) diagonals of the CZs.
        permutations: (permutations, 2^n).
        cnots: (pairs, 3) step, control and target of each CNOT.
        wires: (outputs,) the measured wire, where each output has one.
        eigenvalues: (outputs, 2^n) of the measured products of Z.
    """

    form: NormalForm
    once: np.ndarray
    per_sample: np.ndarray
    codes: np.ndarray
    weight_ranges: np.ndarray
    weight_rows: np.ndarray
    constants: np.ndarray
    input_scales: np.ndarray
    encoding_scales: np.ndarray
    cz_signs: np.ndarray
    permutations: np.ndarray
    cnots: np.ndarray
    wires: np.ndarray
    eigenvalues: np.ndarray

    @cached_property
    def stored_states(self) -> int:
        """States that the backward pass stores: the first one, and one before every operation that is no diagonal."""
        return 1 + int((self.per_sample[:, 0] != DIAGONAL).sum())


def circuit_arrays(form: NormalForm) -> CircuitArrays:
    """The arrays of a normal form."""
    n, fixed_steps = form.wires, form.fixed_steps
    steps: list[Step] = []
    codes: list[int] = []
    once: list[Operation] = [(START, -1, -1, -1)]
    per_sample: list[Operation] = []
    encoding_scales: list[tuple[float, ...]] = []
    permutations: list[np.ndarray] = []
    cnots: list[tuple[int, int, int]] = []

    def add(operations: list[Operation], code: int, step: Step, encoding: int = -1, permutation: int = -1) -> None:
        operations.append((code, len(steps), encoding, permutation))
        steps.append(step)
        codes.append(DIAGONAL if isinstance(step, Diagonal) else code)

    for index, step in enumerate(form.steps[:-1] if form.measures_last_layer else form.steps):
        operations = once if index < fixed_steps else per_sample
        encoding = -1
        if not isinstance(step, CNOTs) and step.angles.scales is not None:
            if step.angles.scales not in encoding_scales:
                encoding_scales.append(step.angles.scales)
            encoding = encoding_scales.index(step.angles.scales)
        if index == fixed_steps and not isinstance(step, Diagonal):
            per_sample.append((START, -1, -1, -1))
        if isinstance(step, CNOTs):
            cnots.extend((len(steps), control, target) for control, target in step.pairs)
            permutations.append(cnot_permutation(step.pairs, n))
            add(operations, PERMUTATION, step, permutation=len(permutations) - 1)
        elif isinstance(step, Diagonal):
            add(operations, START if index == fixed_steps else DIAGONAL, step, encoding)
        elif encoding >= 0:
            add(operations, RY_PER_SAMPLE, step, encoding)
        else:
            if operations[-1][0] not in (START, DIAGONAL):
                add(operations, DIAGONAL, Diagonal())  # it takes the cosines
            add(operations, RY, step)
    if not per_sample:
        per_sample.append((START, -1, -1, -1))
    if form.measures_last_layer:
        steps.append(form.steps[-1])
        codes.append(RY)
    shape = len(steps), n
    weight_rows: list[int] = []
    weight_ranges = [0]
    constants, input_scales = np.zeros(shape), np.zeros(shape)
    signs = np.ones((len(steps), 2**n), dtype=np.float32)
    for index, step in enumerate(steps):
        if not isinstance(step, CNOTs):
            weight_rows.extend(row * 3 + kind for row, kind in step.angles.weights)
            constants[index] += step.angles.constant or 0.0
            input_scales[index] += step.angles.scales or 0.0
            if isinstance(step, Diagonal):
                signs[index] = cz_signs(step.pairs, n)
        weight_ranges.append(len(weight_rows))

    def integers(rows: list[Any], *columns: int) -> np.ndarray:
        return np.array(rows, dtype=np.int64).reshape(len(rows), *columns)

    return CircuitArrays(
        form=form,
        once=integers(once, 4),
        per_sample=integers(per_sample, 4),
        codes=integers(codes),
        weight_ranges=integers(weight_ranges),
        weight_rows=integers(weight_rows),
        constants=constants,
        input_scales=input_scales,
        encoding_scales=np.array(encoding_scales, dtype=np.float64).reshape(len(encoding_scales), n),
        cz_signs=signs,
        permutations=integers(permutations, 2**n),
        cnots=integers(cnots, 3),
        wires=integers([min(product, default=0) for product in form.measured]),
        eigenvalues=z_eigenvalues(form.measured, n),
    )


# Loops rather than expressions of whole arrays: for their checks of shapes Numba compiles its functions of strings,
# which takes longer than all that is here.
@inner
def _fixed_angles(step: int, weight_ranges: Any, weight_rows: Any, constants: Any, weights: Any, total: Any) -> None:
    """Fills `total` (n,): the angles of a step without the input's part."""
    for j in range(len(total)):
        total[j] = constants[step, j]
        for e in range(weight_ranges[step], weight_ranges[step + 1]):
            total[j] += weights[weight_rows[e], j]


@inner
def _bit_mask(x: Any) -> int:
    """The bits that X^x flips in the number of a basis state."""
    mask = 0
    for j in range(len(x)):
        mask |= int(x[j]) << (len(x) - 1 - j)
    return mask


@jit
def bind_weights(
    codes: Any, weight_ranges: Any, weight_rows: Any, constants: Any, cz_signs: Any, cnots: Any, eigenvalues: Any,
    measures_last_layer: bool, weights: Any, tangents: Any, diagonals: Any, flip_masks: Any, angle_signs: Any,
    last_layer: Any, flipped_eigenvalues: Any,
) -> float:  # fmt: skip
    """Fills the arrays after `weights` (rows * 3, n); returns the amplitude of |0...0> to start from.

    tangents (steps, 2, n): for RY the tangents of half angles in row 0; for RY_PER_SAMPLE the cosines and sines of half
        the fixed angles
    diagonals (steps, 2, 2^n): real and imaginary parts, times the cosines of the RY layer that follows
    flip_masks (steps,): bits that the Pauli frame flips
    angle_signs (steps, n): signs that the Pauli frame gives the angles
    last_layer (4, n): factors of <Z> and <X>, and their derivatives by the angle, if measured with the last layer
    flipped_eigenvalues (outputs, 2^n): `eigenvalues` behind the Pauli frame
    """
    n = constants.shape[1]
    x, z = np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
    angle = np.empty(n)
    amplitude = 1.0
    last = len(codes) - 1 if measures_last_layer else len(codes)
    for step in range(len(codes)):
        _fixed_angles(step, weight_ranges, weight_rows, constants, weights, angle)
        mask = _bit_mask(x)
        flip_masks[step] = mask
        if step == last:
            for j in range(n):
                zs, xs = -1.0 if x[j] else 1.0, -1.0 if z[j] else 1.0
                last_layer[0, j], last_layer[1, j] = zs * cos(angle[j]), -xs * sin(angle[j])
                last_layer[2, j], last_layer[3, j] = -zs * sin(angle[j]), -xs * cos(angle[j])
                angle_signs[step, j] = 1.0
        elif codes[step] == DIAGONAL:
            table = diagonals[step]
            table[0, 0], table[1, 0] = 1.0, 0.0
            for j in range(n):
                angle_signs[step, j] = -1.0 if x[j] else 1.0
                c, s = cos(angle[j] / 2), angle_signs[step, j] * sin(angle[j] / 2)
                for k in range((1 << j) - 1, -1, -1):
                    a, b = table[0, k], table[1, k]
                    table[0, 2 * k], table[1, 2 * k] = a * c + b * s, b * c - a * s
                    table[0, 2 * k + 1], table[1, 2 * k + 1] = a * c - b * s, b * c + a * s
            for b in range(1 << n):
                table[0, b] *= cz_signs[step, b ^ mask]
                table[1, b] *= cz_signs[step, b ^ mask]
        elif codes[step] == RY:
            scale = 1.0
            for j in range(n):
                angle_signs[step, j] = -1.0 if x[j] != z[j] else 1.0
                c, s = cos(angle[j] / 2), sin(angle[j] / 2)
                if abs(s) > abs(c):  # k is odd; no digit of a large angle is lost to multiples of pi
                    c, s = s, -c
                    x[j], z[j] = not x[j], not z[j]
                tangents[step, 0, j] = angle_signs[step, j] * s / c
                scale *= abs(c)
            if step > 0 and codes[step - 1] == DIAGONAL:
                for b in range(1 << n):
                    diagonals[step - 1, 0, b] *= scale
                    diagonals[step - 1, 1, b] *= scale
            else:
                amplitude *= scale
        elif codes[step] == RY_PER_SAMPLE:
            for j in range(n):
                angle_signs[step, j] = -1.0 if x[j] != z[j] else 1.0
                tangents[step, 0, j] = cos(angle[j] / 2)
                tangents[step, 1, j] = angle_signs[step, j] * sin(angle[j] / 2)
        else:
            for p in range(len(cnots)):
                if cnots[p, 0] == step:
                    control, target = cnots[p, 1], cnots[p, 2]
                    x[target] = x[target] != x[control]
                    z[control] = z[control] != z[target]
    mask = _bit_mask(x)
    for k in range(len(eigenvalues)):
        for b in range(1 << n):
            flipped_eigenvalues[k, b] = eigenvalues[k, b ^ mask]
    return amplitude


@jit
def add_weight_gradients(weight_ranges: Any, weight_rows: Any, angle_signs: Any, sums: Any, gradient: Any) -> None:
    """Adds the gradients of the angles, `sums` (steps, n), to those of the flat weights, `gradient` (rows * 3, n)."""
    for step in range(len(angle_signs)):
        for e in range(weight_ranges[step], weight_ranges[step + 1]):
            for j in range(sums.shape[1]):
                gradient[weight_rows[e], j] += angle_signs[step, j] * sums[step, j]
