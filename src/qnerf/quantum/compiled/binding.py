"""From angles to what the compiled engine reads: tangents, diagonals, signs. Done once a step, in float64.

RY(angle) = Y^k RY(angle - k pi) up to a phase, with |angle - k pi| <= pi/2, so that |tan| <= 1 in `passes.turn`. The
Y's are never applied: the Pauli string X^x Z^z in front of the state is carried through the circuit instead. It flips
bits in the diagonals behind it, signs of angles (an RY angle where x + z is odd), and at the end the signs of <Z> and
<X>.
"""

from dataclasses import dataclass
from math import cos, sin
from typing import Any

import numpy as np

from qnerf.kernels.jit import jit
from qnerf.quantum.compiled.simd import inner
from qnerf.quantum.normal_form import Permute, Phase, Program, Step, Turn, parities, signs, sources

PHASE, TURN, TURN_EACH, PERMUTE, START = range(5)


@dataclass(frozen=True)
class Tape:
    """A program as arrays. Operations are rows (code, step, table of the input's angles or -1, permutation or -1)."""

    program: Program
    prelude: np.ndarray  # (operations, 4) on |0...0>, once a step
    main: np.ndarray  # (operations, 4) on every sample
    codes: np.ndarray  # (steps,) of all of these steps, and the closing Turn if it is measured locally
    first: np.ndarray  # (steps + 1,) range of each step in `entries`
    entries: np.ndarray  # row * 3 + kind of the weights
    constants: np.ndarray  # (steps, n) radians
    gains: np.ndarray  # (steps, n) scale of the input in each step's angles
    scales: np.ndarray  # (tables, n) the different scales among them
    signs: np.ndarray  # (steps, 2^n) CZ diagonals
    permutations: np.ndarray  # (permutations, 2^n)
    controls: np.ndarray  # (pairs, 3) of CNOTs: step, control, target
    wires: np.ndarray  # (words,) measured wire, if local
    parities: np.ndarray  # (words, 2^n)

    @property
    def slots(self) -> int:
        """States that the backward pass keeps."""
        return 1 + int((self.main[:, 0] != PHASE).sum())


def record(program: Program) -> Tape:
    """The arrays of a program."""
    n, fixed = program.wires, program.fixed_steps
    end = len(program.steps) - 1 if program.local else len(program.steps)
    steps: list[Step] = []
    prelude: list[tuple[int, int, int, int]] = [(START, -1, -1, -1)]
    main: list[tuple[int, int, int, int]] = []
    scales: list[tuple[float, ...]] = []
    permutations: list[np.ndarray] = []
    controls: list[tuple[int, int, int]] = []

    def add(operations: list[tuple[int, int, int, int]], code: int, step: Step, table: int, permutation: int) -> None:
        operations.append((code, len(steps), table, permutation))
        steps.append(step)

    for index, step in enumerate(program.steps[:end]):
        operations = prelude if index < fixed else main
        table = -1
        if not isinstance(step, Permute) and step.angles.scales is not None:
            if step.angles.scales not in scales:
                scales.append(step.angles.scales)
            table = scales.index(step.angles.scales)
        if index == fixed and not isinstance(step, Phase):
            main.append((START, -1, -1, -1))
        if isinstance(step, Permute):
            controls.extend((len(steps), control, target) for control, target in step.pairs)
            permutations.append(sources(step, n))
            add(operations, PERMUTE, step, -1, len(permutations) - 1)
        elif isinstance(step, Phase):
            add(operations, START if index == fixed else PHASE, step, table, -1)
        elif table >= 0:
            add(operations, TURN_EACH, step, table, -1)
        else:
            if operations[-1][0] not in (START, PHASE):
                add(operations, PHASE, Phase(), -1, -1)  # it takes the cosines
            add(operations, TURN, step, -1, -1)
    codes = [PHASE if isinstance(s, Phase) else TURN if isinstance(s, Turn) else PERMUTE for s in steps]
    for code, at, _, _ in (*prelude, *main):
        if code == TURN_EACH:
            codes[at] = TURN_EACH
    if not main:
        main.append((START, -1, -1, -1))
    if program.local:
        steps.append(program.steps[-1])
        codes.append(TURN)
    count = len(steps)
    entries: list[int] = []
    first = [0]
    constants, gains, sign = np.zeros((count, n)), np.zeros((count, n)), np.ones((count, 2**n), dtype=np.float32)
    for index, step in enumerate(steps):
        if not isinstance(step, Permute):
            entries.extend(row * 3 + kind for row, kind in step.angles.entries)
            constants[index] += step.angles.constant or 0.0
            gains[index] += step.angles.scales or 0.0
            if isinstance(step, Phase) and step.pairs:
                sign[index] = signs(step.pairs, n)
        first.append(len(entries))
    return Tape(
        program=program,
        prelude=np.array(prelude, dtype=np.int64),
        main=np.array(main, dtype=np.int64),
        codes=np.array(codes, dtype=np.int64),
        first=np.array(first, dtype=np.int64),
        entries=np.array(entries, dtype=np.int64),
        constants=constants,
        gains=gains,
        scales=np.array(scales, dtype=np.float64).reshape(len(scales), n),
        signs=sign,
        permutations=np.array(permutations, dtype=np.int64).reshape(len(permutations), 2**n),
        controls=np.array(controls, dtype=np.int64).reshape(len(controls), 3),
        wires=np.array([min(word, default=0) for word in program.words], dtype=np.int64),
        parities=parities(program.words, n),
    )


@inner
def angles_of(step: int, first: Any, entries: Any, constants: Any, weights: Any) -> Any:
    """(n,) angles of a step without the input's part. weights: (rows * 3, n)."""
    total = constants[step].copy()
    for e in range(first[step], first[step + 1]):
        total += weights[entries[e]]
    return total


@jit
def bind(
    codes: Any, first: Any, entries: Any, constants: Any, sign: Any, controls: Any, parity: Any, local: bool, weights:
    Any, tangents: Any, tables: Any, masks: Any, flips: Any, closing: Any, parity_out: Any,
) -> float:  # fmt: skip
    """Fills the arrays after `weights`; returns the amplitude of |0...0> to start from.

    tangents (steps, 2, n): tan of half angles of a TURN in row 0; cos and sin of half the fixed angle of a TURN_EACH
    tables (steps, 2, 2^n): diagonals, times the cosines of the TURN behind
    masks (steps,): bits that are flipped      flips (steps, n): sign of each angle in front of its generator
    closing (4, n): factors of <Z>, <X> and their derivatives by the closing angle, if local
    """
    n = constants.shape[1]
    x, z = np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
    amplitude = 1.0
    last = len(codes) - 1 if local else len(codes)
    for step in range(len(codes)):
        angle = angles_of(step, first, entries, constants, weights)
        mask = 0
        for j in range(n):
            mask |= int(x[j]) << (n - 1 - j)
        masks[step] = mask
        if step == last:
            for j in range(n):
                zs, xs = -1.0 if x[j] else 1.0, -1.0 if z[j] else 1.0
                closing[0, j], closing[1, j] = zs * cos(angle[j]), -xs * sin(angle[j])
                closing[2, j], closing[3, j] = -zs * sin(angle[j]), -xs * cos(angle[j])
                flips[step, j] = 1.0
        elif codes[step] == PHASE:
            table = tables[step]
            table[0, 0], table[1, 0] = 1.0, 0.0
            for j in range(n):
                flips[step, j] = -1.0 if x[j] else 1.0
                c, s = cos(angle[j] / 2), flips[step, j] * sin(angle[j] / 2)
                for k in range((1 << j) - 1, -1, -1):
                    a, b = table[0, k], table[1, k]
                    table[0, 2 * k], table[1, 2 * k] = a * c + b * s, b * c - a * s
                    table[0, 2 * k + 1], table[1, 2 * k + 1] = a * c - b * s, b * c + a * s
            for b in range(1 << n):
                table[0, b] *= sign[step, b ^ mask]
                table[1, b] *= sign[step, b ^ mask]
        elif codes[step] == TURN:
            scale = 1.0
            for j in range(n):
                flips[step, j] = -1.0 if x[j] != z[j] else 1.0
                c, s = cos(angle[j] / 2), sin(angle[j] / 2)
                if abs(s) > abs(c):  # k is odd; no digit of a large angle is lost to multiples of pi
                    c, s = s, -c
                    x[j], z[j] = not x[j], not z[j]
                tangents[step, 0, j] = flips[step, j] * s / c
                scale *= abs(c)
            if step > 0 and codes[step - 1] == PHASE:
                tables[step - 1] *= scale
            else:
                amplitude *= scale
        elif codes[step] == TURN_EACH:
            for j in range(n):
                flips[step, j] = -1.0 if x[j] != z[j] else 1.0
                tangents[step, 0, j] = cos(angle[j] / 2)
                tangents[step, 1, j] = flips[step, j] * sin(angle[j] / 2)
        else:
            for p in range(len(controls)):
                if controls[p, 0] == step:
                    control, target = controls[p, 1], controls[p, 2]
                    x[target] = x[target] != x[control]
                    z[control] = z[control] != z[target]
    mask = 0
    for j in range(n):
        mask |= int(x[j]) << (n - 1 - j)
    for k in range(len(parity)):
        for b in range(1 << n):
            parity_out[k, b] = parity[k, b ^ mask]
    return amplitude


@jit
def unbind(first: Any, entries: Any, flips: Any, sums: Any, gradient: Any) -> None:
    """gradient (rows * 3, n) += the sums (steps, n) of each step's angles."""
    for step in range(len(flips)):
        for e in range(first[step], first[step + 1]):
            gradient[entries[e]] += flips[step] * sums[step]
