"""The Pauli form of any circuit: rotations exp(-i angle/2 P) about Pauli words P, then Pauli words that are measured.

Every gate is a product of such rotations (`gates`). Rotations by multiples of pi/2 are Clifford operations. They turn
Pauli words into Pauli words, so they are carried to the end of the circuit and into the measurement: CNOT, H, SWAP and
the others cost nothing. Two rotations about the same word merge if all between them commute with it. A rotation about a
word of Z's on |0...0> has no effect. A rotation that commutes with all that follows has no effect either.

>>> from qnerf.quantum.circuit import ANSATZE
>>> form = pauli_form(ANSATZE.build("cnot", 2, 1))
>>> len(form.rotations), form.fixed_rotations, len(form.words)
(17, 8, 2)
"""

from dataclasses import dataclass
from functools import lru_cache
from math import pi
from typing import NamedTuple

import numpy as np

from qnerf.quantum.circuit import (
    Amplitudes,
    Circuit,
    Encoding,
    Entangler,
    Gate,
    Operation,
    PauliWord,
    Probabilities,
    Rotations,
    as_sum,
    feature,
    values_of,
    weight,
)
from qnerf.quantum.expressions import Expression

QUARTER_TOLERANCE = 1e-13  # an angle this near to a multiple of pi/2, in units of pi/2, is one


class Word(NamedTuple):
    """i^phase X^x Z^z on `wires` wires; wire 0 is the most significant bit of x and z, as of a basis state."""

    x: int
    z: int
    phase: int

    @staticmethod
    def of(letters: str, wires: tuple[int, ...], n: int) -> "Word":
        """The product of `letters` on `wires` of n."""
        x = sum(1 << (n - 1 - wire) for wire, letter in zip(wires, letters, strict=True) if letter in "XY")
        z = sum(1 << (n - 1 - wire) for wire, letter in zip(wires, letters, strict=True) if letter in "ZY")
        return Word(x, z, (x & z).bit_count() % 4)

    def __mul__(self, other: "Word") -> "Word":  # type: ignore[override]
        sign = 2 * (self.z & other.x).bit_count()
        return Word(self.x ^ other.x, self.z ^ other.z, (self.phase + other.phase + sign) % 4)

    def times(self, phase: int) -> "Word":
        """i^phase times the word."""
        return Word(self.x, self.z, (self.phase + phase) % 4)

    def commutes(self, other: "Word") -> bool:
        return ((self.x & other.z).bit_count() + (self.z & other.x).bit_count()) % 2 == 0

    @property
    def sign(self) -> int:
        """+1 or -1, the sign of a Hermitian word in front of its letters."""
        return 1 - (self.phase - (self.x & self.z).bit_count()) % 4

    @property
    def letters(self) -> "Word":
        """A Hermitian word with the sign +1."""
        return Word(self.x, self.z, (self.x & self.z).bit_count() % 4)


class _Frame:
    """A Clifford operation C that has been carried to the end: for each generator Q = X_j or Z_j the word C^-1 Q C."""

    def __init__(self, n: int) -> None:
        self.n = n
        self.of_x = {1 << j: Word(1 << j, 0, 0) for j in range(n)}
        self.of_z = {1 << j: Word(0, 1 << j, 0) for j in range(n)}

    def __call__(self, word: Word) -> Word:
        """C^-1 word C."""
        out = Word(0, 0, word.phase)
        for images, bits in ((self.of_x, word.x), (self.of_z, word.z)):
            while bits:
                bit = bits & -bits
                out = out * images[bit]
                bits ^= bit
        return out

    def append(self, word: Word, quarters: int) -> None:
        """Another operation at the end: the rotation about `word` by `quarters` times pi/2."""
        image = self(word)
        for images, other in ((self.of_x, word.z), (self.of_z, word.x)):
            while other:  # the generators that do not commute with the word
                bit = other & -other
                images[bit] = images[bit].times(2) if quarters == 2 else (image * images[bit]).times(quarters)
                other ^= bit


class Rotation(NamedTuple):
    """exp(-i angle/2 word)."""

    word: Word
    angle: Expression


@dataclass(frozen=True)
class PauliForm:
    """`rotations` on the start, then the values that are measured.

    Attributes:
        circuit: where it comes from.
        rotations: in the order in which they act.
        words: measured words, all different, with the sign +1.
        tables: for each `Probabilities` the outcome (2^n,) that a basis state counts for.
        combination: (outputs, words and outcomes of the tables); outputs = combination @ values + constants.
        constants: (outputs,).
    """

    circuit: Circuit
    rotations: tuple[Rotation, ...]
    words: tuple[Word, ...]
    tables: tuple[np.ndarray, ...]
    combination: np.ndarray
    constants: np.ndarray

    @property
    def wires(self) -> int:
        return self.circuit.wires

    @property
    def start(self) -> tuple[Amplitudes, ...]:
        """What sets the amplitudes of the start; empty for |0...0>."""
        return tuple(operation for operation in self.circuit.operations if isinstance(operation, Amplitudes))

    @property
    def fixed_rotations(self) -> int:
        """Number of leading rotations that do not depend on the input. They run once for a whole batch."""
        if any(Expression.of(angle).features for part in self.start for angle in part.angles):
            return 0
        for index, rotation in enumerate(self.rotations):
            if rotation.angle.features:
                return index
        return len(self.rotations)

    @property
    def outcomes(self) -> int:
        """Number of probabilities that are measured."""
        return sum(int(table.max()) + 1 for table in self.tables)


@lru_cache(maxsize=256)
def pauli_form(circuit: Circuit) -> PauliForm:
    """The Pauli form of `circuit`."""
    n = circuit.wires
    frame, rotations = _Frame(n), _Rotations(circuit)
    for gate in only_gates(circuit):
        for part in gate.rotations:
            rotations.add(frame, Word.of(part.letters, gate.wires, n), gate.angle_of(part))
    tables = _diagonal_tables(circuit, frame, rotations)
    index: dict[Word, int] = {}
    combined: list[dict[int, float]] = []
    constants: list[float] = []
    first = 0  # outcomes so far
    for observable in circuit.observables:
        if isinstance(observable, Probabilities):
            outcomes = values_of(observable)
            combined += [{-1 - k: 1.0} for k in range(first, first + outcomes)]
            constants += [0.0] * outcomes
            first += outcomes
            continue
        sums = as_sum(observable)
        combined.append({})
        constants.append(0.0)
        for coefficient, word in zip(sums.coefficients, sums.words, strict=True):
            image = frame(_word(word, n))
            if image.x == image.z == 0:
                constants[-1] += coefficient * image.sign
                continue
            column = index.setdefault(image.letters, len(index))
            combined[-1][column] = combined[-1].get(column, 0.0) + coefficient * image.sign
    combination = np.zeros((len(combined), len(index) + first))
    for row, entries in enumerate(combined):
        for column, value in entries.items():
            combination[row, column if column >= 0 else len(index) - 1 - column] = value
    generators = [
        frame(Word.of("Z", (w,), n)) for o in circuit.observables if isinstance(o, Probabilities) for w in o.wires
    ]
    kept = rotations.that_matter([*index, *generators])
    return PauliForm(circuit, tuple(kept), tuple(index), tables, combination, np.array(constants))


def as_gates(operation: Operation, circuit: Circuit) -> list[Gate]:
    """The gates of an operation; an empty list for `Amplitudes`."""
    wires = range(circuit.wires)
    if isinstance(operation, Gate):
        return [operation]
    if isinstance(operation, Rotations):
        return [Gate("Rot", (wire,), _stacked(operation.row, wire, circuit)) for wire in wires]
    if isinstance(operation, Entangler):
        return [Gate(operation.gate, pair) for pair in operation.pairs]
    if isinstance(operation, Encoding):
        return [Gate(f"R{operation.axis}", (w,), (operation.scales[w] * feature(w),)) for w in wires]
    return []


def only_gates(circuit: Circuit) -> list[Gate]:
    """All gates of a circuit in order, without its `Amplitudes`."""
    return [gate for operation in circuit.operations for gate in as_gates(operation, circuit)]


def _stacked(row: int, wire: int, circuit: Circuit) -> tuple[Expression, ...]:
    """The three angles of a wire in a row of `weights1` and `weights2`."""
    first = circuit.spectral * circuit.sublayers
    name, row = ("weights1", row) if row < first else ("weights2", row - first)
    return tuple(weight(name, (row * circuit.wires + wire) * 3 + kind) for kind in range(3))


def _word(word: PauliWord, n: int) -> Word:
    return Word.of("".join(letter for _, letter in word), tuple(wire for wire, _ in word), n)


class _Rotations:
    """The rotations so far, merged."""

    def __init__(self, circuit: Circuit) -> None:
        self.rotations: list[Rotation] = []
        free = list(range(circuit.wires))
        for operation in circuit.operations:
            if isinstance(operation, Amplitudes):
                free = [wire for wire in free if wire not in operation.wires]
        self.zero = sum(1 << (circuit.wires - 1 - wire) for wire in free)  # the wires that start in |0>

    def add(self, frame: _Frame, word: Word, angle: Expression) -> None:
        """A rotation at the end of the circuit, before the frame; a Clifford operation joins the frame."""
        turned = quarters(angle)
        if turned is not None:
            if turned:
                frame.append(word, turned)
            return
        image = frame(word)
        self._merge(Rotation(image.letters, angle * image.sign))

    def _merge(self, new: Rotation) -> None:
        for index in range(len(self.rotations) - 1, -1, -1):
            word, angle = self.rotations[index]
            if word == new.word:
                total = angle + new.angle
                if total.terms:
                    self.rotations[index] = Rotation(word, total)
                else:
                    del self.rotations[index]
                return
            if not word.commutes(new.word):
                break
        else:
            if new.word.x == 0 and new.word.z & ~self.zero == 0:
                return  # |0...0> is an eigenstate
        self.rotations.append(new)

    def add_fixed(self, word: Word) -> None:
        """A rotation by pi/2 that is not carried on."""
        self._merge(Rotation(word.letters, Expression.of(pi / 2 * word.sign)))

    def that_matter(self, measured: list[Word]) -> list[Rotation]:
        """Those that do not commute with all that follows."""
        kept: list[Rotation] = []
        later = list(measured)
        for rotation in reversed(self.rotations):
            if not all(map(rotation.word.commutes, later)):
                kept.append(rotation)
                later.append(rotation.word)
        return kept[::-1]


def quarters(angle: Expression) -> int | None:
    """0..3 if the angle is a multiple of pi/2, else None."""
    constant = angle.constant
    if constant is None:
        return None
    turns = constant / (pi / 2)
    whole = round(turns)
    return whole % 4 if abs(turns - whole) <= QUARTER_TOLERANCE * max(1.0, abs(turns)) else None


def _diagonal_tables(circuit: Circuit, frame: _Frame, rotations: _Rotations) -> tuple[np.ndarray, ...]:
    """The tables of all probabilities; adds the rotations that make what they measure diagonal.

    Z_w on the wires becomes the word frame(Z_w). These words commute, so one rotation by pi/2 for each makes them words
    of Z's: about i g Z_j, where wire j carries an X or Y of the word g.
    """
    n = circuit.wires
    asked = [o.wires for o in circuit.observables if isinstance(o, Probabilities)]
    for wire in sorted({wire for wires in asked for wire in wires}):
        image = frame(Word.of("Z", (wire,), n))
        if image.x:
            z = Word(0, image.x & -image.x, 0)
            about = (image * z).times(1)
            rotations.add_fixed(about)
            inverse = _Frame(n)  # P -> R P R^-1
            inverse.append(about.letters, 3 if about.sign > 0 else 1)
            frame.of_x = {bit: inverse(word) for bit, word in frame.of_x.items()}
            frame.of_z = {bit: inverse(word) for bit, word in frame.of_z.items()}
    basis = np.arange(2**n) if asked else np.zeros(0, dtype=np.int64)
    tables = []
    for wires in asked:
        outcome = np.zeros_like(basis)
        for wire in wires:
            image = frame(Word.of("Z", (wire,), n))
            assert image.x == 0, "the words of a measurement commute"
            odd = np.bitwise_count(basis & image.z).astype(np.int64) & 1
            outcome = 2 * outcome + (odd ^ (image.sign < 0))
        tables.append(outcome)
    return tuple(tables)
