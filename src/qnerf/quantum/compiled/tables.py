"""From a program and its angles to the tables that the compiled engine reads: tangents, phases, signs. Once a step.

A program becomes `ProgramArrays` once. `bind` then turns the fixed angles of a step, (F,) float64, into `Tables`.

RY layers run with tangents (`forward_passes.ry_layer`). To keep |tan| <= 1, RY(angle) = Y^k RY(angle - k pi) up to a
phase, with |angle - k pi| <= pi/2. The Y's are never applied. They are carried through the circuit as a Pauli frame, a
product X^x Z^z on each wire in front of the state. The frame flips bits in the diagonals that follow, flips signs of
angles (of an RY angle where x + z is odd), and in the end flips the signs of what is measured.

The cosines that a layer of tangents lacks are one number. It is a factor of the last diagonal before the layer.
"""

from functools import cached_property
from math import cos, sin
from typing import Any, NamedTuple

import numpy as np

from qnerf.kernels.jit import jit
from qnerf.kernels.simd import inner
from qnerf.quantum.angles import Angles
from qnerf.quantum.basis import cnot_permutation
from qnerf.quantum.blocks import CNOTs, Diagonal, RYLayer, Tilts
from qnerf.quantum.program import Program
from qnerf.quantum.words import Word

DIAGONAL, RY, PERMUTATION, START, TURN, START_EACH, TILTS = range(7)
CODE, TABLE, PHASES, EVEN, SEVERAL, FIRST, LAST, UNDO, FOLD, MOVED, MIDDLE = range(11)
"""The columns of an operation: its kind; its row in the tables of its kind, or -1; its row in the phases of the input,
or -1; whether these are of even products; whether a product of several Z's has a gradient here; its first tap and the
one after its last; whether the backward pass needs the state before it; for RY, the operation that takes the cosines.
A permutation has phases behind it, of row TABLE, and before it, of the next row, which also have the taps before
MIDDLE; MOVED is its own row.
"""
SOURCE, FIXED, COLUMN, MASK = range(4)
"""The columns of a tap, where a gradient is read: wire or mask; the number of the fixed angle, or -1; the column of the
input, or -1; the wires as bits."""


class Steps(NamedTuple):
    """A program without its angles. Compiled loops take it as it is."""

    operations: Any  # (operations, 11), those that run once, then those that run for every sample
    taps: Any  # (taps, 4)
    constants: Any  # (diagonals, 2, 2^n) real and imaginary parts of the constant phases
    cnots: Any  # (pairs, 3) row of the permutation, control and target bit of each CNOT
    turns: Any  # (turns, 6) a word (see `word_passes`), 1 if its angle moves with the input, the angle's number


class Tables(NamedTuple):
    """What a step needs of the angles. Compiled loops take it as it is."""

    tangents: Any  # (layers, n) of half the angles of RY layers
    diagonals: Any  # (diagonals, 2, 2^n) real and imaginary parts, times the cosines of an RY layer
    flip_masks: Any  # (operations,) bits that the Pauli frame flips; of tilts, whether any has derivatives
    signs: Any  # (taps,) that the Pauli frame gives the angles
    squares: Any  # (operations,) of the cosines that the state here still lacks or has too many of
    permutations: Any  # (permutations, 2^n) of the CNOTs, whatever the angles are


class Measurement(NamedTuple):
    """What is measured. Compiled loops take it as it is."""

    measures_last_layer: Any  # whether <Z> and <X> before the last RY layer are measured instead of <Z> after it
    masks: Any  # (words of Z's,) the wires of each as bits
    signs: Any  # (words of Z's,) that the Pauli frame gives them
    last_layer: Any  # (4, n) factors of <Z> and <X> before the last RY layer, and their derivatives by its angle


class Extra(NamedTuple):
    """What only some programs have; None for the others, whose loops are compiled without it."""

    turns: Any  # (turns, 6), with the signs of the Pauli frame
    fixed: Any  # (2, F) cos and sin of half the fixed angles
    products: Any  # (products, 3) row of the phases, mask and moving angle of each product of several Z's
    words: Any  # (words, 4) that are measured and are not of Z's alone, with the signs of the Pauli frame
    outcomes: Any  # (tables, 2^n) of the basis states, behind the Pauli frame
    firsts: Any  # (tables + 1,) where the outcomes of each table begin
    starts: Any  # (blocks, 2, 2^n, width) the start of each sample; or no blocks


class ProgramArrays:
    """A program as arrays, without its angles.

    Attributes:
        once: number of operations that run once for a batch, on |0...0> or the start.
        steps: all operations, and the last RY layer if it is part of the measurement.
        applied: (operations, 11) without a last RY layer that is part of the measurement.
        factors: (taps,) the input's factor in the angle.
        last_taps: (n,) the tap of each wire in the last RY layer, if it is part of the measurement; -1 for none.
        singles: (phases, n) the number of the moving angle of each wire; that past the last one stands for 0.
    """

    def __init__(self, program: Program, angles: Angles) -> None:
        self.program, n = program, program.wires
        self.n, self.inputs = n, angles.inputs
        self.rows: list[list[int]] = [[START, -1, -1, 0, 0, 0, 0, 0, -1, -1, -1]]
        self.taps: list[tuple[int, int, int, int]] = []
        self.tap_factors: list[float] = []
        self.constants: list[np.ndarray] = []
        self.phases: list[tuple[tuple[int, int], ...]] = []
        self.evens: list[bool] = []
        self.pairs: list[tuple[int, int, int]] = []
        self.tables: list[np.ndarray] = []
        self.turn_rows: list[tuple[int, ...]] = []
        self.layers = 0
        self._add_blocks(angles)
        self._mark_undone()
        z_words = [word for word in program.words if not word.x]
        others = [word for word in program.words if word.x]
        self.steps = Steps(
            _integers(self.rows, 11), _integers(self.taps, 4),
            np.array([[c.real, c.imag] for c in self.constants]).reshape(-1, 2, 2**n),
            _integers(self.pairs, 3), _integers(self.turn_rows, 6),
        )  # fmt: skip
        self.measures_last_layer = np.bool_(program.measures_last_layer)
        self.applied = self.steps.operations[: len(self.rows) - program.measures_last_layer]
        self.last_taps = np.full(n, -1, dtype=np.int64)
        if program.measures_last_layer:
            for tap in range(self.rows[-1][FIRST], self.rows[-1][LAST]):
                self.last_taps[self.taps[tap][SOURCE]] = tap
        self.factors = np.array(self.tap_factors)
        self.permutations = _integers(self.tables, 2**n)
        count = len(angles.inputs.columns)
        self.singles = np.full((len(self.phases), n), count, dtype=np.int64)
        products = []
        for row, own in enumerate(self.phases):
            for mask, angle in own:
                if mask.bit_count() == 1:
                    self.singles[row, n - mask.bit_length()] = angle
                else:
                    products.append((row, mask, angle))
        self.products = _integers(products, 3)
        self.masks = _integers([word.z for word in z_words])
        self.words = _integers([word_row(word) for word in others], 4)
        self.outcomes = _integers(list(program.tables), 2**n)
        self.firsts = np.cumsum([0, *(int(table.max()) + 1 for table in program.tables)]).astype(np.int64)
        self.is_plain = not (
            self.turn_rows or products or any(self.evens) or any(row[SEVERAL] for row in self.rows)
            or others or program.tables or program.start_moves
        )  # fmt: skip

    def _add_blocks(self, angles: Angles) -> None:
        program = self.program
        blocks = program.blocks
        self.once = -1
        for group in (*program.groups, ()):
            first = blocks[group[0]] if group else None
            fused = False
            if self.once < 0 and (not group or group[0] >= program.fixed_blocks):
                self.once = len(self.rows)
                odd = (word for word, _, moving in angles.rotations[group[0]] if moving >= 0) if group else ()
                fused = isinstance(first, Diagonal) and any(word.z.bit_count() % 2 for word in odd)
                fused = fused and not program.start_moves
                if not fused:
                    self.rows.append([START_EACH if program.start_moves else START, -1, -1, *[0] * 5, -1, -1, -1])
            if any(isinstance(blocks[place], CNOTs) for place in group):
                self._add_cnots(group, angles)
            elif group:
                self._add(group[0], angles, fused)
        if program.measures_last_layer:
            self._add_layer(angles.rotations[-1], -1)

    def _add_cnots(self, group: tuple[int, ...], angles: Angles) -> None:
        """CNOTs with the fixed phases before and behind them."""
        phases: list[np.ndarray | None] = [None, None]
        first = middle = len(self.taps)
        behind = 0
        for place in group:
            block = self.program.blocks[place]
            if isinstance(block, CNOTs):
                self.pairs.extend((len(self.tables), control, target) for control, target in block.pairs)
                self.tables.append(cnot_permutation(block.pairs, self.n))
                middle, behind = len(self.taps), 1
                continue
            phases[1 - behind] = angles.phases[place]
            for word, own, _ in angles.rotations[place]:
                if own >= 0:
                    self._tap((2 - behind) * self.n - word.z.bit_length(), own, -1, word.z)
        self.constants += [np.ones(2**self.n, complex) if own is None else own for own in phases]
        self._operation(PERMUTATION, len(self.constants) - 2, taps=len(self.taps) - first)
        self.rows[-1][MOVED:] = len(self.tables) - 1, middle

    def _add(self, place: int, angles: Angles, fused: bool) -> None:
        block, rows = self.program.blocks[place], angles.rotations[place]
        if isinstance(block, Diagonal):
            self._add_diagonal(rows, angles.phases[place], fused)
        elif isinstance(block, Tilts):
            for word, own, other in rows:
                self._tap(self.n - word.x.bit_length(), own, other, word.x)
            self._operation(TILTS, -1, taps=len(rows))
        elif isinstance(block, RYLayer):
            fold = self._fold()
            if fold is None:
                self._add_diagonal([], None, False)
                fold = len(self.rows) - 1
            self._add_layer(rows, fold)
        else:
            ((word, own, other),) = rows
            self.turn_rows.append((*word_row(word), int(other >= 0), own if other < 0 else other))
            self._tap(0, own, other, 0)
            self._operation(TURN, len(self.turn_rows) - 1, taps=1)

    def _fold(self) -> int | None:
        """The operation that takes the cosines of a layer: the last diagonal since the last layer, or the start."""
        for index in range(len(self.rows) - 1, -1, -1):
            code, row = self.rows[index][CODE], self.rows[index][TABLE]
            if code == RY:
                return None
            if code in (DIAGONAL, PERMUTATION) or (code == START and (row >= 0 or index == 0)):
                return index
            if code in (START, START_EACH):
                return None
        return None

    def _add_layer(self, rows: list[tuple[Word, int, int]], fold: int) -> None:
        for word, own, other in rows:
            self._tap(self.n - word.x.bit_length(), own, other, word.x)
        self._operation(RY, self.layers, taps=len(rows), fold=fold)
        self.layers += 1

    def _add_diagonal(self, rows: list[tuple[Word, int, int]], phases: np.ndarray | None, fused: bool) -> None:
        """A diagonal: phases of the input of odd products of Z, and another operation for those of even ones."""
        even = [(word.z, other) for word, _, other in rows if other >= 0 and word.z.bit_count() % 2 == 0]
        masks = {mask for mask, _ in even}
        odd = [(word.z, other) for word, _, other in rows if other >= 0 and word.z not in masks]
        main = [(word.z, own, -1 if word.z in masks else other) for word, own, other in rows]
        self._phases_operation(START if fused else DIAGONAL, main, odd, phases, False)
        if even:
            self._phases_operation(DIAGONAL, [(mask, -1, other) for mask, other in even], even, None, True)

    def _phases_operation(
        self, code: int, entries: list[tuple[int, int, int]], moving: list[tuple[int, int]],
        phases: np.ndarray | None, even: bool,
    ) -> None:  # fmt: skip
        entries = [entry for entry in entries if entry[1] >= 0 or entry[2] >= 0]
        several = any(mask.bit_count() > 1 for mask, _, _ in entries)
        for mask, own, other in entries:
            self._tap(mask if several else self.n - mask.bit_length(), own, other, mask)
        row, key = -1, tuple(sorted(moving))
        if key:
            if key not in self.phases:
                self.phases.append(key)
                self.evens.append(even)
            row = self.phases.index(key)
        self.constants.append(np.ones(2**self.n, complex) if phases is None else phases)
        self._operation(code, len(self.constants) - 1, row, even, several, len(entries))

    def _tap(self, source: int, fixed: int, moving: int, mask: int) -> None:
        column = self.inputs.columns[moving] if moving >= 0 else -1
        self.taps.append((source, fixed, column, mask))
        self.tap_factors.append(self.inputs.factors[moving] if moving >= 0 else 0.0)

    def _operation(
        self, code: int, table: int, phases: int = -1, even: bool = False, several: bool = False, taps: int = 0,
        fold: int = -1,
    ) -> None:  # fmt: skip
        last = len(self.taps)
        self.rows.append([code, table, phases, int(even), int(several), last - taps, last, 0, fold, -1, -1])

    def _mark_undone(self) -> None:
        """What works in place needs the state right behind it: diagonals after it are taken off the state again."""
        needed = False
        for row in self.rows:
            if row[CODE] == DIAGONAL:
                row[UNDO] = int(needed)
            has_taps = row[CODE] == PERMUTATION and row[LAST] > row[FIRST]
            needed = row[CODE] in (DIAGONAL, TURN, TILTS) or (row[CODE] == START and row[TABLE] >= 0) or has_taps

    @cached_property
    def stored_states(self) -> int:
        """States that the backward pass stores: the first one, and one before every layer and every permutation."""
        return 1 + sum(row[CODE] in (RY, PERMUTATION) for row in self.rows[self.once :])


def word_row(word: Word) -> tuple[int, int, int, int]:
    """A word as `word_passes` take it."""
    return word.x, word.z, word.phase % 2, word.phase // 2


def _integers(rows: list[Any], *columns: int) -> np.ndarray:
    return np.array(rows, dtype=np.int64).reshape(len(rows), *columns)


# Loops rather than expressions of whole arrays: for their checks of shapes Numba compiles its functions of strings,
# which takes longer than all that is here.
@inner
def _odd(value: int) -> bool:
    """Whether an odd number of bits is set."""
    odd = False
    while value:
        value &= value - 1
        odd = not odd
    return odd


@inner
def _bind_diagonal(
    row: int, first: int, last: int, steps: Steps, fixed: Any, x: int, n: int, spare: Any, tables: Tables
) -> None:
    """The phases of all basis states, wire by wire: each phase of j wires becomes two phases of j + 1 wires."""
    spare[0, 0], spare[1, 0] = 1.0, 0.0
    for j in range(n):
        angle = 0.0
        for k in range(first, last):
            tap = steps.taps[k]
            if tap[MASK] == 1 << (n - 1 - j) and tap[FIXED] >= 0:
                angle = fixed[tap[FIXED]]
        c, s = cos(angle / 2), sin(angle / 2)
        # From the last state to the first, so that no phase is overwritten before it was read.
        for k in range((1 << j) - 1, -1, -1):
            a, b = spare[0, k], spare[1, k]
            spare[0, 2 * k], spare[1, 2 * k] = a * c + b * s, b * c - a * s
            spare[0, 2 * k + 1], spare[1, 2 * k + 1] = a * c - b * s, b * c + a * s
    # Then the products of several Z's, one by one.
    for k in range(first, last):
        tap = steps.taps[k]
        tables.signs[k] = -1.0 if _odd(tap[MASK] & x) else 1.0
        if tap[FIXED] >= 0 and tap[MASK] & (tap[MASK] - 1):
            c, sine = cos(fixed[tap[FIXED]] / 2), sin(fixed[tap[FIXED]] / 2)
            for b in range(1 << n):
                s = -sine if _odd(b & tap[MASK]) else sine
                spare[0, b], spare[1, b] = spare[0, b] * c + spare[1, b] * s, spare[1, b] * c - spare[0, b] * s
    table, constants = tables.diagonals[row], steps.constants[row]
    for b in range(1 << n):
        u, v = spare[0, b ^ x], spare[1, b ^ x]
        table[0, b] = u * constants[0, b ^ x] - v * constants[1, b ^ x]
        table[1, b] = u * constants[1, b ^ x] + v * constants[0, b ^ x]


@inner
def _bind_ry(op: Any, steps: Steps, fixed: Any, x: int, z: int, n: int, tables: Tables) -> Any:
    """The tangents of half angles; returns the wires with a Y that enters the frame, and the product of the cosines."""
    scale, turned = 1.0, 0
    for j in range(n):
        tables.tangents[op[TABLE], j] = 0.0
    for k in range(op[FIRST], op[LAST]):
        tap = steps.taps[k]
        sign = -1.0 if (x ^ z) & tap[MASK] else 1.0
        tables.signs[k] = sign
        c, s = cos(fixed[tap[FIXED]] / 2), sin(fixed[tap[FIXED]] / 2)
        if abs(s) > abs(c):  # k is odd; no digit of a large angle is lost to multiples of pi
            c, s = s, -c
            turned |= tap[MASK]
        tables.tangents[op[TABLE], tap[SOURCE]] = sign * s / c
        scale *= abs(c)
    return turned, scale


@inner
def _bind_last_layer(op: Any, steps: Steps, fixed: Any, x: int, z: int, n: int, tables: Tables, factors: Any) -> None:
    """<Z> after the last RY layer is cos <Z> - sin <X> before it; the frame flips the signs of both."""
    for j in range(n):
        place, angle = 1 << (n - 1 - j), 0.0
        for k in range(op[FIRST], op[LAST]):
            if steps.taps[k, MASK] == place:
                angle = fixed[steps.taps[k, FIXED]]
                tables.signs[k] = 1.0
        zs, xs = -1.0 if x & place else 1.0, -1.0 if z & place else 1.0
        factors[0, j], factors[1, j] = zs * cos(angle), -xs * sin(angle)
        factors[2, j], factors[3, j] = -zs * sin(angle), -xs * cos(angle)


@inner
def _fold(o: int, op: Any, scale: float, operations: Any, n: int, tables: Tables) -> float:
    """The cosines of a layer go into the diagonal before it, or else into the amplitude of the start (returned)."""
    for k in range(op[FOLD], o + 1):
        tables.squares[k] = scale * scale
    row = operations[op[FOLD], TABLE]
    if row < 0:
        return scale
    for b in range(1 << n):
        tables.diagonals[row, 0, b] *= scale
        tables.diagonals[row, 1, b] *= scale
    return 1.0


@jit
def bind(steps: Steps, fixed: Any, n: int, spare: Any, measurement: Measurement, tables: Tables, frame: Any) -> float:
    """Fills `tables`, `measurement` and `frame`; returns the amplitude of |0...0> to start from.

    fixed (F,): the fixed angles, radians
    spare (2, 2^n): work space
    frame (turns + 1, 2): the Pauli frame (x, z) at each turn, and at the end
    """
    operations = steps.operations
    x, z = 0, 0  # the Pauli frame
    amplitude = 1.0
    last = len(operations) - 1 if measurement.measures_last_layer else len(operations)
    # The operations in order, because each of them may change the frame of all that follow.
    for o in range(len(operations)):
        op = operations[o]
        tables.flip_masks[o], tables.squares[o] = x, 1.0
        if o == last:
            _bind_last_layer(op, steps, fixed, x, z, n, tables, measurement.last_layer)
        elif op[CODE] == RY:
            turned, scale = _bind_ry(op, steps, fixed, x, z, n, tables)
            x, z = x ^ turned, z ^ turned
            amplitude *= _fold(o, op, scale, operations, n, tables)
        elif op[CODE] == PERMUTATION:
            row = op[TABLE]
            _bind_diagonal(row + 1, op[FIRST], op[MIDDLE], steps, fixed, x, n, spare, tables)
            # X spreads to the target, Z to the control.
            for p in range(len(steps.cnots)):
                if steps.cnots[p, 0] == op[MOVED]:
                    control, target = steps.cnots[p, 1], steps.cnots[p, 2]
                    if x & control:
                        x ^= target
                    if z & target:
                        z ^= control
            _bind_diagonal(row, op[MIDDLE], op[LAST], steps, fixed, x, n, spare, tables)
            before, behind = tables.diagonals[row + 1], tables.diagonals[row]
            for b in range(1 << n):
                u, v = before[0, tables.permutations[op[MOVED], b]], before[1, tables.permutations[op[MOVED], b]]
                behind[0, b], behind[1, b] = u * behind[0, b] - v * behind[1, b], u * behind[1, b] + v * behind[0, b]
        elif op[CODE] == TURN:
            tables.signs[op[FIRST]] = 1.0
            frame[op[TABLE], 0], frame[op[TABLE], 1] = x, z
        elif op[CODE] == TILTS:
            for k in range(op[FIRST], op[LAST]):
                tables.signs[k] = -1.0 if z & steps.taps[k, MASK] else 1.0
            tables.flip_masks[o] = 0
            for k in range(op[FIRST], op[LAST]):
                if fixed[steps.taps[k, FIXED]] != 0:
                    tables.flip_masks[o] = 1
        elif op[TABLE] >= 0:
            _bind_diagonal(op[TABLE], op[FIRST], op[LAST], steps, fixed, x, n, spare, tables)
    # What is left of the frame at the end flips signs of what is measured.
    frame[len(frame) - 1, 0], frame[len(frame) - 1, 1] = x, z
    for k in range(len(measurement.masks)):
        measurement.signs[k] = -1.0 if _odd(measurement.masks[k] & x) else 1.0
    return amplitude
