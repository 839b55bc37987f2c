"""A circuit as a program: a short list of blocks that every engine runs, then what is measured.

Every gate is a product of rotations exp(-i angle/2 P) about Pauli words P (`gates`). They become these blocks:

- `Diagonal`: rotations about words of Z's, one phase for each amplitude;
- `RYLayer`: RY on some wires, by angles without data: real, and fast for many wires at once;
- `Tilts`: no rotation, but derivatives of one;
- `CNOTs`: a permutation of the amplitudes;
- `Turn`: a rotation about any other word.

From `PRODUCT_WIRES` on, a product of rotations of one wire is RZ RY RZ with angles of each step (`angles.Products`); a
rotation by data is RZ between fixed rotations. A rotation joins the earliest block of its kind that it can move back
to, past all that it commutes with. So gates merge, in whatever order they are written. Rotations by pi are Pauli words:
they are carried to the end of the circuit, and turn signs of angles on their way. Two equal CNOTs with phases between
them become other phases. What has no effect on the start or on what is measured is left out.

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
from itertools import chain, zip_longest
from math import pi

import numpy as np
from torch import Tensor

from qnerf.quantum.basis import bit, placed
from qnerf.quantum.blocks import (
    CNOT_COST,
    LAYER_COST,
    TURN_COST,
    Block,
    CNOTs,
    Diagonal,
    RYLayer,
    Tilts,
    Turn,
    cost_of,
    merged,
    moves,
    rotations_of,
    traced,
    turn_phases,
    union,
)
from qnerf.quantum.circuit import Circuit, Gate, Observable, PauliWord, Probabilities, as_sum, values_of
from qnerf.quantum.expressions import Expression, weight
from qnerf.quantum.gates import Amplitudes
from qnerf.quantum.one_wire import Factors, Product, append, half_turns, with_moving_phases
from qnerf.quantum.words import Word, bits, through_cnot

PRODUCT_WIRES = 7  # below, a layer of the state is quicker than working out the angles of a product
PRODUCTS = "one-wire products"  # no identifier, as names of weights are


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
        products: rotations of one wire, in the order in which they act; the weights PRODUCTS are their angles
            phi, theta, xi, omega, one product after the other.
    """

    circuit: Circuit
    blocks: tuple[Block, ...]
    observed: tuple[tuple[Word, ...], ...]
    words: tuple[Word, ...]
    combination: np.ndarray | None
    constants: np.ndarray
    products: tuple[Factors, ...]

    @property
    def wires(self) -> int:
        return self.circuit.wires

    @property
    def start(self) -> tuple[Amplitudes, ...]:
        """What sets the amplitudes of the start; empty for |0...0>."""
        return tuple(operation for operation in self.circuit.operations if isinstance(operation, Amplitudes))

    def sources(self, angle: Expression) -> list[Expression]:
        """What an angle depends on: its terms, and the factors of products in it."""
        own = Expression(tuple(term for term in angle.terms if not any(name == PRODUCTS for name, _ in term[1])))
        products = {index // 4 for name, index in angle.weights if name == PRODUCTS}
        return [own, *(factor for index in sorted(products) for _, factor in self.products[index])]

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
    def read(self) -> tuple[PauliWord | Probabilities, ...]:
        """What a device would read one by one: the words, then the probabilities."""
        letters = {bit(wire, self.wires): wire for wire in range(self.wires)}
        words = [
            tuple(
                (letters[own], "X" if not own & word.z else "Y" if own & word.x else "Z") for own in bits(word.support)
            )
            for word in self.words
        ]
        return (*words, *(each for each in self.circuit.observables if isinstance(each, Probabilities)))

    def outputs(self, values: Tensor) -> Tensor:
        """Outputs (B, outputs) for the values (B, values) of the words and of the outcomes."""
        if self.combination is None:
            return values
        matrix, constants = (placed(own, values.device, values.dtype) for own in (self.combination, self.constants))
        return values @ matrix.T + constants

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
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """The places of the blocks, without a last layer that is measured; CNOTs with the fixed phases beside them."""
        groups: list[tuple[int, ...]] = []
        for place, block in enumerate(self.blocks[: len(self.blocks) - self.measures_last_layer]):
            last = self.blocks[groups[-1][-1]] if groups else None
            before, after = (isinstance(own, Diagonal) and own.joins_cnots for own in (last, block))
            before = before and isinstance(block, CNOTs) and len(groups[-1]) == 1
            if before or (after and isinstance(last, CNOTs)):
                groups[-1] += (place,)
            else:
                groups.append((place,))
        return tuple(groups)

    @cached_property
    def operations(self) -> int:
        """Multiply-adds for each sample, forward and backward; the backward pass runs the forward pass again."""
        n = self.wires
        run = [group for group in self.groups if self.fixed_blocks <= group[0]]
        total = sum(
            cost_of(self.blocks[group[0]], n) if len(group) == 1 else CNOT_COST + 5 * len(group) for group in run
        )
        others = sum(word.x != 0 for word in self.words) + 2 * len(self.outcomes)
        total += 3 * n + 9 if self.measures_last_layer else 2 * n + 7 * others + 2
        return 2**n * (total + 8 * self.start_moves + 4)


@lru_cache(maxsize=256)
def program(circuit: Circuit) -> Program:
    """The cheaper program of a circuit: with new blocks as early, or as late, as they can be."""
    return min((_built(circuit, late) for late in (False, True)), key=lambda each: each.operations)


@lru_cache(maxsize=256)
def unmerged(circuit: Circuit) -> Program:
    """The gates one by one, and the observables as they are: what noise after each gate meets."""
    blocks: list[Block] = []
    for gate in circuit.gates:
        if gate.name == "CNOT":
            blocks.append(CNOTs([(bit(gate.wires[0], circuit.wires), bit(gate.wires[1], circuit.wires))]))
        else:
            words = ((Word.of(part.letters, gate.wires, circuit.wires), gate.angle_of(part)) for part in gate.rotations)
            blocks += [Turn(word, angle) for word, angle in words if angle.terms]
    return _Measured(circuit.observables, Word(0, 0, 0), circuit.wires).program(circuit, tuple(blocks))


def _built(circuit: Circuit, late: bool) -> Program:
    builder = _Builder(circuit, late)
    for gate, ready in zip(circuit.gates, _ready(circuit), strict=True):
        builder.flush(ready)
        builder.add_gate(gate)
    return builder.finish()


def _ready(circuit: Circuit) -> list[int]:
    """For each gate of several wires those, as bits, whose next gate is one of several wires, too."""
    ready, out = 0, []
    for gate in reversed(circuit.gates):
        own = sum(bit(wire, circuit.wires) for wire in gate.wires)
        ready = ready | own if len(gate.wires) > 1 else ready & ~own
        out.append(ready if len(gate.wires) > 1 else 0)
    return out[::-1]


class _Builder:
    """The blocks so far, and the Pauli word that is carried behind them."""

    def __init__(self, circuit: Circuit, late: bool) -> None:
        self.circuit, self.n, self.late = circuit, circuit.wires, late
        self.blocks: list[Block] = []
        self.products: list[Product] = []
        self.carried = Word(0, 0, 0)
        self.waiting: dict[int, Product] = {}  # wire -> its last rotations, which may grow
        taken = {wire for part in circuit.operations if isinstance(part, Amplitudes) for wire in part.wires}
        self.zero = sum(bit(wire, self.n) for wire in range(self.n) if wire not in taken)  # wires still in |0>

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
        place = word.support
        if place.bit_count() == 1 and (word.x or place in self.waiting):
            append(self.waiting.setdefault(place, []), word, angle)
            return
        self.flush(place)
        angle = self._carried_past(word, angle)
        if word.x:
            self._join(Turn, word, angle)
        else:
            self._phase(word, angle)

    def _carried_past(self, word: Word, angle: Expression) -> Expression:
        """The angle behind the carried word; nothing is left of multiples of pi, which join that word."""
        turns = half_turns(angle)
        if turns is None:
            return angle if self.carried.commutes(word) else -angle
        if turns % 2:
            self.carried = self.carried * word
        return Expression()

    def flush(self, wires: int) -> None:
        """Places the last rotations of these wires, side by side: phases, tilts and RY of all of them in turn."""
        found = [self._slots(place) for place in [place for place in self.waiting if place & wires]]
        for place, slots in enumerate(zip_longest(*found, fillvalue=())):
            for word, angle in chain(*slots):
                if place % 3 == 0:
                    self._phase(word, angle)
                else:
                    self._join(Tilts if place % 3 == 1 else RYLayer, word, angle)

    def _slots(self, place: int) -> list[Product]:
        """The waiting rotations of a wire as phases, tilts, RY, phases, and so on in turn."""
        slots: list[Product] = [[]]
        core: Product = []  # rotations without data, the first of them about X or Y
        for word, angle in with_moving_phases(self.waiting.pop(place)):
            angle = self._carried_past(word, angle)
            if word.x or (core and not angle.features):
                append(core, word, angle)
            else:
                slots[-1:] = self._turned(slots[-1], core, place)
                slots[-1].append((word, angle))
                core = []
        slots[-1:] = self._turned(slots[-1], core, place)
        return slots

    def _turned(self, phases: Product, core: Product, place: int) -> list[Product]:
        """Phases, and rotations after them, as phases, tilts, RY and phases."""
        if not core:
            return [phases]
        x, y, z = Word(place, 0, 0), Word(place, place, 1), Word(0, place, 0)
        after = [core.pop()] if not core[-1][0].x else []
        if len(core) == 1 or self.n < PRODUCT_WIRES:  # RY, or RX = RZ(-pi/2) RY RZ(pi/2), one after the other
            slots = [list(phases)]
            for word, angle in core:
                if not word.x:
                    slots[-1].append((word, angle))
                    continue
                quarter = Expression.of(0.0 if word.z else pi / 2)
                slots[-1].append((z, quarter))
                slots += [[], [(y, angle)], [(z, -quarter)]]
            slots[-1] += after
            return slots
        phi, theta, xi, omega = (weight(PRODUCTS, 4 * len(self.products) + k) for k in range(4))
        self.products.append(core)
        trains = any(angle.constant is None for _, angle in core)
        return [[*phases, (z, phi)], [(x, xi)] if trains else [], [(y, theta)], [(z, omega), *after]]

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

    def _join(self, kind: type[Diagonal | RYLayer | Tilts | Turn], word: Word, angle: Expression) -> None:
        """Adds a rotation to the earliest block of its kind that it can move back to, or to a new one."""
        if not angle.terms:
            return
        self.zero &= ~word.x
        first = self._reached(lambda block: block.commutes(word))
        for block in self.blocks[first:]:
            if isinstance(block, kind) and (not isinstance(block, Turn) or block.word == word):
                block.add(word, angle)
                return
        new = Turn(word.letters, Expression()) if kind is Turn else kind()  # type: ignore[call-arg]
        new.add(word, angle)
        self.blocks.insert(len(self.blocks) if self.late else first, new)

    def _reached(self, passes: Callable[[Block], bool]) -> int:
        """The first place that an operation reaches on its way back."""
        place = len(self.blocks)
        while place and passes(self.blocks[place - 1]):
            place -= 1
        return place

    def add_cnot(self, control: int, target: int) -> None:
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
                        self.blocks = merged(own for own in self.blocks if own is not block or block.pairs)
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
        measured = _Measured(observables, self.carried, self.n)
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
        return measured.program(
            self.circuit, tuple(_small_layers_turned(merged(kept[::-1]), self.n)), tuple(map(tuple, self.products))
        )

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


def _small_layers_turned(blocks: list[Block], n: int) -> list[Block]:
    """The blocks with small RY layers as turns, unless they are the last block."""
    turned: list[Block] = []
    for block in blocks:
        if isinstance(block, RYLayer) and block is not blocks[-1] and TURN_COST * len(block.angles) < LAYER_COST * n:
            turned += [Turn(*rotation) for rotation in rotations_of(block, n)]
        else:
            turned.append(block)
    return turned


def _word(word: PauliWord, n: int) -> Word:
    return Word.of([letter for _, letter in word], [wire for wire, _ in word], n)


class _Measured:
    """What is measured, as Pauli words: those of the outputs, and Z of every wire of which bits are read."""

    def __init__(self, observables: tuple[Observable, ...], carried: Word, n: int) -> None:
        self.observables = observables
        self.words: list[list[Word]] = []
        for observable in observables:
            if isinstance(observable, Probabilities):
                words = [Word.of("Z", (wire,), n) for wire in observable.wires]
            else:
                words = [_word(word, n) for word in as_sum(observable).words]
            flipped = [0 if carried.commutes(word) else 2 for word in words]
            self.words.append([Word(w.x, w.z, (w.phase + f) % 4) for w, f in zip(words, flipped, strict=True)])

    def union(self) -> tuple[int, int]:
        return union(word for words in self.words for word in words)

    def turn(self, cnots: CNOTs) -> None:
        """The words before the CNOTs that equal these behind them."""
        self.words = [list(map(cnots.turned, words)) for words in self.words]

    def program(self, circuit: Circuit, blocks: tuple[Block, ...], products: tuple[Factors, ...] = ()) -> Program:
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
        combined = None if are_values else combination
        return Program(circuit, blocks, observed, tuple(columns), combined, constants, products)
