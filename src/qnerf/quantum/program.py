"""A circuit as a program: a short list of blocks that every engine runs, then what is measured.

Every gate is a product of rotations exp(-i angle/2 P) about Pauli words P (`gates`). They become four kinds of blocks:

- `Diagonal`: rotations about words of Z's, one phase for each amplitude;
- `RYLayer`: RY on some wires, by angles without data: real, and fast for many wires at once;
- `CNOTs`: a permutation of the amplitudes;
- `Turn`: a rotation about any other word.

A rotation joins the earliest block of its kind that it can move back to, past all that it commutes with. So gates
merge, in whatever order they are written. Rotations by pi are Pauli words: they are carried to the end of the circuit,
and turn signs of angles on their way. RX is RY between fixed phases; a rotation by data is RZ between fixed rotations.
Two equal CNOTs with phases between them become other phases. What has no effect on the start or on what is measured is
left out.

>>> from qnerf.quantum.circuit import ANSATZE
>>> found = program(ANSATZE.build("qiren", 4, 1))
>>> [type(block).__name__ for block in found.blocks]
['RYLayer', 'Diagonal', 'RYLayer', 'Diagonal', 'RYLayer', 'Diagonal', 'RYLayer']
>>> found.fixed_blocks  # the encoding is in the second diagonal
3
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import pi
from typing import Literal

import numpy as np

from qnerf.quantum.basis import bit
from qnerf.quantum.blocks import (
    Block,
    CNOTs,
    Diagonal,
    RYLayer,
    Turn,
    add_angle,
    moves,
    rotations_of,
    traced,
    turn_phases,
    union,
)
from qnerf.quantum.circuit import Circuit, Gate, Observable, PauliWord, Probabilities, as_sum, values_of
from qnerf.quantum.expressions import Expression
from qnerf.quantum.gates import Amplitudes
from qnerf.quantum.words import Word, bits, through_cnot

TOLERANCE = 1e-13  # an angle this near to a multiple of pi, in units of pi, is one
LARGEST_MULTIPLE = 64  # beyond, the rounding of the angle says nothing about multiples of pi
TURN_COST, LAYER_COST, CNOT_COST = 19, 8, 8
"""Multiply-adds for each amplitude, forward and backward, or what takes as long: of a turn, of a wire in a layer of RY,
of a permutation."""


@dataclass(frozen=True, eq=False)
class Program:
    """`blocks` on the start, then the values that are measured.

    Attributes:
        circuit: where it comes from.
        blocks: in the order in which they act.
        observed: for each observable its Pauli words behind the blocks; of `Probabilities`, Z of each wire.
        words: measured words, all different, with the sign +1; those of Z's alone come first.
        combination: (outputs, words and outcomes of the tables); outputs = combination @ values + constants. None where
            the outputs are the values.
        constants: (outputs,).
    """

    circuit: Circuit
    blocks: tuple[Block, ...]
    observed: tuple[tuple[Word, ...], ...]
    words: tuple[Word, ...]
    combination: np.ndarray | None
    constants: np.ndarray

    @property
    def wires(self) -> int:
        return self.circuit.wires

    @property
    def start(self) -> tuple[Amplitudes, ...]:
        """What sets the amplitudes of the start; empty for |0...0>."""
        return tuple(operation for operation in self.circuit.operations if isinstance(operation, Amplitudes))

    @cached_property
    def start_moves(self) -> bool:
        """Whether the start depends on the input."""
        return any(Expression.of(angle).features for part in self.start for angle in part.angles)

    @cached_property
    def fixed_blocks(self) -> int:
        """Number of leading blocks that do not depend on the input. They run once for a whole batch."""
        if self.start_moves:
            return 0
        for index, block in enumerate(self.blocks):
            if moves(block):
                return index
        return len(self.blocks)

    @cached_property
    def outcomes(self) -> tuple[int, ...]:
        """Number of probabilities of each `Probabilities`."""
        return tuple(values_of(each) for each in self.circuit.observables if isinstance(each, Probabilities))

    @cached_property
    def tables(self) -> tuple[np.ndarray, ...]:
        """For each `Probabilities` the outcome (2^n,) that a basis state counts for."""
        basis, tables = np.arange(2**self.wires if self.outcomes else 0), []
        for observable, words in zip(self.circuit.observables, self.observed, strict=True):
            if isinstance(observable, Probabilities):
                outcome = np.zeros_like(basis)
                for word in words:
                    assert word.x == 0, "CNOTs turn words of Z's into words of Z's"
                    odd = np.bitwise_count(basis & word.z).astype(np.int64) & 1
                    outcome = 2 * outcome + (odd ^ (word.sign < 0))
                tables.append(outcome)
        return tuple(tables)

    @cached_property
    def measures_last_layer(self) -> bool:
        """Whether the last RY layer can be part of the measurement.

        <Z> after RY(a) is cos(a) <Z> - sin(a) <X> before it. This needs values of one Z each, and a last layer that
        comes after the first data.
        """
        single = all(word.x == 0 and word.z.bit_count() == 1 for word in self.words)
        last = self.blocks[-1] if self.blocks else None
        return isinstance(last, RYLayer) and single and not self.outcomes and self.fixed_blocks < len(self.blocks) - 1

    @cached_property
    def operations(self) -> int:
        """Multiply-adds for each sample, forward and backward; the backward pass runs the forward pass again."""
        n, total = self.wires, 0
        blocks = self.blocks[self.fixed_blocks : len(self.blocks) - self.measures_last_layer]
        for block in blocks:
            total += _cost(block, n)
        values = len(self.words) + 2 * len(self.outcomes)
        total += 3 * n + 9 if self.measures_last_layer else 7 * values + 2
        return 2**n * (total + 8 * self.start_moves + 4)


def _cost(block: Block, n: int) -> int:
    if isinstance(block, RYLayer):
        return LAYER_COST * n
    if isinstance(block, CNOTs):
        return CNOT_COST
    if isinstance(block, Turn):
        return TURN_COST
    several = sum(mask.bit_count() > 1 and not angle.constant for mask, angle in block.angles.items())
    return (25 if moves(block) else 13) + (n + 6 * several if several else 0)


Style = Literal["phases", "turns", "words"]
"""Rotations RX and RY by data are phases between fixed rotations, or turns; or all rotations but phases are turns, and
CNOTs turn their words."""


@lru_cache(maxsize=256)
def program(circuit: Circuit) -> Program:
    """The cheapest program of a circuit."""
    return min((_built(circuit, style) for style in _styles(circuit)), key=lambda each: each.operations)


def _styles(circuit: Circuit) -> list[Style]:
    """The styles that make a difference to a circuit."""
    styles: list[Style] = ["phases"]
    turned = (gate.angle_of(part) for gate in circuit.gates for part in gate.rotations if set(part.letters) & set("XY"))
    if any(angle.features for angle in turned):
        styles.append("turns")
    if any(gate.name in ("CNOT", "SWAP") for gate in circuit.gates):
        styles.append("words")
    return styles


@lru_cache(maxsize=256)
def unmerged(circuit: Circuit) -> Program:
    """The gates one by one, and the observables as they are: what noise after each gate meets."""
    blocks: list[Block] = []
    for gate in circuit.gates:
        if gate.name == "CNOT":
            blocks.append(CNOTs([(bit(gate.wires[0], circuit.wires), bit(gate.wires[1], circuit.wires))]))
        else:
            words = ((Word.of(part.letters, gate.wires, circuit.wires), gate.angle_of(part)) for part in gate.rotations)
            blocks += [Turn(word, angle) for word, angle in words]
    return _Measured(circuit.observables, lambda word: word, Word(0, 0, 0), circuit.wires).program(
        circuit, tuple(blocks)
    )


def _built(circuit: Circuit, style: Style) -> Program:
    builder = _Builder(circuit, style)
    for operation in circuit.operations:
        if isinstance(operation, Gate):
            builder.add_gate(operation)
    return builder.finish()


class _Builder:
    """The blocks so far, and the Pauli word that is carried behind them."""

    def __init__(self, circuit: Circuit, style: Style) -> None:
        self.circuit, self.n, self.style = circuit, circuit.wires, style
        self.blocks: list[Block] = []
        self.carried = Word(0, 0, 0)
        self.waiting: dict[int, tuple[Word, Expression]] = {}  # wire -> its last rotation, which may grow
        taken = {wire for part in circuit.operations if isinstance(part, Amplitudes) for wire in part.wires}
        self.zero = sum(bit(wire, self.n) for wire in range(self.n) if wire not in taken)  # wires still in |0>
        # What the CNOTs so far make of X and Z of each wire, where they turn words.
        self.of_x = {1 << place: 1 << place for place in range(self.n)}
        self.of_z = dict(self.of_x)

    def add_gate(self, gate: Gate) -> None:
        pairs = {"CNOT": [(0, 1)], "SWAP": [(0, 1), (1, 0), (0, 1)]}.get(gate.name)
        places = [bit(wire, self.n) for wire in gate.wires]
        if pairs is not None:
            for a, b in pairs:
                self.add_cnot(places[a], places[b])
            return
        for part in gate.rotations:
            self.add(Word.of(part.letters, gate.wires, self.n), gate.angle_of(part))

    def add(self, word: Word, angle: Expression) -> None:
        """A rotation about a word, at the end of the circuit."""
        image = self.image(word)
        word, place = image.letters, image.support
        if image.sign < 0:
            angle = -angle
        before, waiting = self.waiting.get(place, (None, Expression()))
        if before != word:
            self.flush(place)
        if not self.carried.commutes(word):
            angle = -angle
        if before == word:
            self.waiting[place] = word, waiting + angle
        elif word.x and place.bit_count() == 1:
            self.waiting[place] = word, angle
        else:
            self._place(word, angle)

    def flush(self, wires: int) -> None:
        """Places the last rotations of these wires."""
        for place in [place for place in self.waiting if place & wires]:
            self._place(*self.waiting.pop(place))

    def image(self, word: Word) -> Word:
        """The word before the CNOTs that turn words."""
        if self.style != "words":
            return word
        x = z = 0
        for place in bits(word.x):
            x ^= self.of_x[place]
        for place in bits(word.z):
            z ^= self.of_z[place]
        return Word(x, z, word.phase)

    def _place(self, word: Word, angle: Expression) -> None:
        turns = half_turns(angle)
        if turns is not None:
            if turns % 2:
                self.carried = self.carried * word
        elif word.x == 0:
            self._phase(word, angle)
        elif word.support.bit_count() > 1 or self.style == "words" or (angle.features and self.style == "turns"):
            self._join(Turn, word, angle)
        elif angle.features:
            self._place_moving(word, angle)
        else:
            # RY, or RX = RZ(-pi/2) RY RZ(pi/2).
            quarter, z = Expression.of(0.0 if word.z else pi / 2), Word(0, word.x, 0)
            self._phase(z, quarter)
            self._join(RYLayer, Word(word.x, word.x, 1), angle)
            self._phase(z, -quarter)

    def _place_moving(self, word: Word, angle: Expression) -> None:
        """RX(a) = RY(pi/2) RZ(a) RY(-pi/2), or RY(a) = RZ(pi/2) RX(a) RZ(-pi/2), by an angle that depends on data."""
        quarter, own = Expression.of(pi / 2), Expression.of(pi / 2 if word.z else 0.0)
        y, z = Word(word.x, word.x, 1), Word(0, word.x, 0)
        self._phase(z, -own)
        self._join(RYLayer, y, -quarter)
        self._phase(z, angle)
        self._join(RYLayer, y, quarter)
        self._phase(z, own)

    def _phase(self, word: Word, angle: Expression) -> None:
        """A phase, unless |0...0> is an eigenstate. A constant one also moves back through CNOTs: it costs nothing."""
        if not word.z & ~self.zero or not angle.terms:
            return
        if angle.constant is None:
            self._join(Diagonal, word, angle)
            return
        found: tuple[Diagonal, Word] | None = None
        first = len(self.blocks)
        for block in reversed(self.blocks):
            if isinstance(block, Diagonal):
                found = block, word
            elif isinstance(block, CNOTs):
                word = block.turned(word)
            elif not block.commutes(word):
                break
            first -= 1
        if found is None:
            found = Diagonal(), word
            self.blocks.insert(first, found[0])
        found[0].add(found[1], angle)

    def _join(self, kind: type[Diagonal] | type[RYLayer] | type[Turn], word: Word, angle: Expression) -> None:
        """Adds a rotation to the earliest block of its kind that it can move back to, or to a new one."""
        self.zero &= ~word.x
        first = self._reached(lambda block: block.commutes(word))
        for block in self.blocks[first:]:
            if isinstance(block, kind) and (not isinstance(block, Turn) or block.word == word):
                block.add(word, angle)
                return
        new = Turn(word.letters, Expression()) if kind is Turn else kind()  # type: ignore[call-arg]
        new.add(word, angle)
        self.blocks.insert(first, new)

    def _reached(self, passes: Callable[[Block], bool]) -> int:
        """The first place that an operation reaches on its way back."""
        place = len(self.blocks)
        while place and passes(self.blocks[place - 1]):
            place -= 1
        return place

    def add_cnot(self, control: int, target: int) -> None:
        if self.style == "words":
            self.of_x[control] ^= self.of_x[target]
            self.of_z[target] ^= self.of_z[control]
            return
        self.flush(control | target)
        self.carried = through_cnot(self.carried, control, target)
        if control & self.zero:
            return
        self.zero &= ~target
        if self._cancels(control, target):
            return

        first = self._reached(lambda block: block.passes_cnot(control, target))
        if first and isinstance(self.blocks[first - 1], CNOTs):
            first -= 1
        for block in self.blocks[first:]:
            if isinstance(block, CNOTs):
                block.append(control, target)
                return
        self.blocks.insert(first, CNOTs([(control, target)]))

    def _cancels(self, control: int, target: int) -> bool:
        """Whether the CNOT undoes an earlier one; the phases between them then become other phases."""
        turned: list[Diagonal] = []
        for block in reversed(self.blocks):
            if isinstance(block, CNOTs):
                for k in range(len(block.pairs) - 1, -1, -1):
                    a, b = block.pairs[k]
                    if (a, b) == (control, target):
                        del block.pairs[k]
                        for each in turned:
                            turn_phases(each, control, target)
                        return True
                    if a == target or b == control:
                        return False
            elif not block.passes_cnot(control, target):
                if not isinstance(block, Diagonal):
                    return False
                turned.append(block)
        return False

    def finish(self) -> Program:
        observables = self._as_z()
        self.flush(-1)
        measured = _Measured(observables, self.image, self.carried, self.n)
        kept: list[Block] = []
        x, z = measured.union()
        for block in reversed(self.blocks):
            if isinstance(block, CNOTs) and not kept:  # at the end: they turn what is measured
                measured.turn(block)
                x, z = measured.union()
                continue
            own, x, z = traced(block, x, z)
            if own is not None:
                kept.append(own)
        return measured.program(self.circuit, tuple(_joined(kept[::-1], self.n)))

    def _as_z(self) -> tuple[Observable, ...]:
        """The observables; where each is one letter and every wire has one letter, as Z after a rotation."""
        observables = self.circuit.observables
        letters: dict[int, str] = {}
        for word in observables:
            if not isinstance(word, tuple) or len(word) != 1 or letters.setdefault(*word[0]) != word[0][1]:
                return observables
        for wire, letter in letters.items():
            if letter != "Z":
                turn = ("X", pi / 2) if letter == "Y" else ("Y", -pi / 2)
                self.add(Word.of(turn[0], (wire,), self.n), Expression.of(turn[1]))
        return tuple(((word[0][0], "Z"),) for word in observables if isinstance(word, tuple))


def _joined(blocks: list[Block], n: int) -> list[Block]:
    """The blocks, neighbours of one kind as one, and small RY layers as turns, unless they are the last block."""
    out: list[Block] = []
    for block in blocks:
        last = out[-1] if out else None
        if isinstance(block, Diagonal | RYLayer) and type(last) is type(block):
            for mask, angle in block.angles.items():
                add_angle(last.angles, mask, angle)
        else:
            out.append(block)
    turned: list[Block] = []
    for block in out:
        if isinstance(block, RYLayer) and block is not out[-1] and TURN_COST * len(block.angles) < LAYER_COST * n:
            turned += [Turn(*rotation) for rotation in rotations_of(block, n)]
        else:
            turned.append(block)
    return turned


def _word(word: PauliWord, n: int) -> Word:
    return Word.of([letter for _, letter in word], [wire for wire, _ in word], n)


class _Measured:
    """What is measured, as Pauli words: those of the outputs, and Z of every wire of which bits are read."""

    def __init__(
        self, observables: tuple[Observable, ...], image: Callable[[Word], Word], carried: Word, n: int
    ) -> None:
        self.observables = observables
        self.words: list[list[Word]] = []
        for observable in observables:
            if isinstance(observable, Probabilities):
                words = [Word.of("Z", (wire,), n) for wire in observable.wires]
            else:
                words = [_word(word, n) for word in as_sum(observable).words]
            words = list(map(image, words))
            flipped = [0 if carried.commutes(word) else 2 for word in words]
            self.words.append([Word(w.x, w.z, (w.phase + f) % 4) for w, f in zip(words, flipped, strict=True)])

    def union(self) -> tuple[int, int]:
        return union(word for words in self.words for word in words)

    def turn(self, cnots: CNOTs) -> None:
        """The words before the CNOTs that equal these behind them."""
        self.words = [list(map(cnots.turned, words)) for words in self.words]

    def program(self, circuit: Circuit, blocks: tuple[Block, ...]) -> Program:
        each = zip(self.observables, self.words, strict=True)
        sums = [word for observable, words in each if not isinstance(observable, Probabilities) for word in words]
        found = dict.fromkeys(word.letters for word in sums if word.support)
        columns = {word: k for k, word in enumerate(sorted(found, key=lambda word: word.x != 0))}
        outcomes = sum(values_of(own) for own in self.observables if isinstance(own, Probabilities))
        rows, places = circuit.outputs, iter(range(len(columns), len(columns) + outcomes))
        combination, constants, row = np.zeros((rows, len(columns) + outcomes)), np.zeros(rows), 0
        for observable, words in zip(self.observables, self.words, strict=True):
            if isinstance(observable, Probabilities):
                for _ in range(values_of(observable)):
                    combination[row, next(places)] = 1.0
                    row += 1
                continue
            for coefficient, word in zip(as_sum(observable).coefficients, words, strict=True):
                if word.support:
                    combination[row, columns[word.letters]] += coefficient * word.sign
                else:
                    constants[row] += coefficient * word.sign
            row += 1
        are_values = not constants.any() and np.array_equal(combination, np.eye(rows))
        observed = tuple(map(tuple, self.words))
        return Program(circuit, blocks, observed, tuple(columns), None if are_values else combination, constants)


def half_turns(angle: Expression) -> int | None:
    """The angle as a multiple of pi if it is one, else None."""
    constant = angle.constant
    if constant is None:
        return None
    whole = round(constant / pi)
    return whole if abs(constant / pi - whole) <= TOLERANCE and abs(whole) <= LARGEST_MULTIPLE else None
