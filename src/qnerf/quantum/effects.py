"""What of a circuit has no effect: mistakes that raise no error, read from its program.

>>> from qnerf.quantum.circuit import Gate, Weights, feature
>>> w = Weights("w", (2,))
>>> gates = Gate("RX", 0, feature(0)), Gate("RX", 0, w[0]), Gate("RZ", 1, w[1])
>>> for line in without_effect(Circuit("mine", 2, gates, (((0, "Z"),), ((1, "Z"),)), weights=w)):
...     print(line)
no output depends on w[1]
no output depends on x[1]
output 1 is constant
all rotations by x[0] commute with every trainable gate; a rotation about another axis would not
"""

import warnings
from collections.abc import Iterator, Sequence
from functools import lru_cache

import numpy as np

from qnerf.quantum.basis import bit
from qnerf.quantum.blocks import rotations_of, traced, union
from qnerf.quantum.circuit import ANSATZE, Circuit, values_of
from qnerf.quantum.expressions import Expression
from qnerf.quantum.one_wire import half_turns
from qnerf.quantum.program import program
from qnerf.quantum.words import Word, bits

SHOWN = 5  # names in one line


@lru_cache(maxsize=256)
def without_effect(circuit: Circuit) -> tuple[str, ...]:
    """One line for each kind of mistake; what a program does not show is not said.

    - Weights and features that no output depends on. In QIREN these are angles of rotations about Z: the first phi of
      each wire turns a phase of `|0...0>`, and the last omega comes before phases and a measurement of Z.
    - Outputs that depend on nothing, and outputs that depend on no feature though others do.
    - Features whose rotations all commute with every trainable gate. A weight then only adds to the phases that the
      feature turns.
    """
    return (*_idle_weights(circuit), *_idle_inputs(circuit))


def warn(circuit: Circuit) -> None:
    """Warns of each line of `without_effect`. The weights of a circuit that has a name in `ANSATZE` are known."""
    known = circuit.name in ANSATZE.names()
    for line in _idle_inputs(circuit) if known else without_effect(circuit):
        warnings.warn(f"circuit {circuit.name}: {line}", stacklevel=4)


def _idle_weights(circuit: Circuit) -> Iterator[str]:
    used = {own for angles in _angles_of_outputs(circuit) for angle in angles for own in angle.weights}
    idle = [
        f"{own.name}[{', '.join(map(str, index))}]" if index else own.name
        for own in circuit.weights
        for place, index in enumerate(np.ndindex(*own.shape))
        if (own.name, place) not in used
    ]
    if idle:
        yield f"no output depends on {_listed(idle)}"


def _idle_inputs(circuit: Circuit) -> Iterator[str]:
    outputs = _angles_of_outputs(circuit)
    used = {index for angles in outputs for angle in angles for index in angle.features}
    if idle := [f"x[{index}]" for index in range(circuit.features or 0) if index not in used]:
        yield f"no output depends on {_listed(idle)}"
    constant = [k for k, angles in enumerate(outputs) if not any(a.weights or a.features for a in angles)]
    still = [k for k, angles in enumerate(outputs) if not any(angle.features for angle in angles)]
    for found, what in ((constant, "constant"), ([k for k in still if k not in constant], "the same for every input")):
        if found and (used or what == "constant"):
            several = len(found) > 1
            yield f"output{'s' if several else ''} {_listed(found)} {'are' if several else 'is'} {what}"
    if commuting := [f"x[{index}]" for index in _commuting(circuit) if index in used]:
        yield (
            f"all rotations by {_listed(commuting)} commute with every trainable gate; "
            "a rotation about another axis would not"
        )


def _listed(names: Sequence[object]) -> str:
    more = len(names) - SHOWN
    return ", ".join(map(str, names[:SHOWN])) + (f" and {more} more" if more > 0 else "")


@lru_cache(maxsize=256)
def _angles_of_outputs(circuit: Circuit) -> list[list[Expression]]:
    """For each output the angles, and the amplitudes of the start, that it may depend on."""
    found, outputs = program(circuit), []
    for observable, words in zip(circuit.observables, found.observed, strict=True):
        x, z = union(words)
        angles: list[Expression] = []
        for block in reversed(found.blocks):
            own, x, z = traced(block, x, z)
            for _, angle in rotations_of(own, circuit.wires) if own is not None else ():
                angles += found.sources(angle)
        for part in found.start:
            if any(bit(wire, circuit.wires) & (x | z) for wire in part.wires):
                angles += map(Expression.of, part.angles)
        outputs += [angles] * values_of(observable)
    return outputs


def _commuting(circuit: Circuit) -> list[int]:
    """The features whose rotations commute with every trainable gate, in a circuit that trains.

    Fixed gates of the Clifford group turn words into words; any other fixed gate counts as trainable. A feature that a
    weight multiplies is left out: its frequency trains.
    """
    frame = _Frame(circuit.wires)
    encodings: dict[int, set[Word]] = {}
    others: set[Word] = set()
    scaled: set[int] = set()
    for gate in circuit.gates:
        for part in gate.rotations:
            word, angle = Word.of(part.letters, gate.wires, circuit.wires), gate.angle_of(part)
            quarters = half_turns(angle * 2)
            if quarters is not None:
                frame.turn(word if quarters % 2 else Word(0, 0, 0))
                continue
            own = frame.image(word)
            for index in angle.features:
                encodings.setdefault(index, set()).add(own)
            if angle.weights or not angle.features:
                others.add(own)
            scaled.update(index for _, weights, features in angle.terms if weights for index in features)
    if not any(angle.weights for gate in circuit.gates for angle in map(Expression.of, gate.angles)):
        return []
    return [
        index
        for index, words in sorted(encodings.items())
        if index not in scaled and all(one.commutes(two) for one in words for two in others)
    ]


class _Frame:
    """What the Clifford gates so far make of a word behind them, without its sign."""

    def __init__(self, wires: int) -> None:
        places = [bit(wire, wires) for wire in range(wires)]
        self.of_x = {place: Word(place, 0, 0) for place in places}
        self.of_z = {place: Word(0, place, 0) for place in places}

    def image(self, word: Word) -> Word:
        x = z = 0
        for part in (*(self.of_x[place] for place in bits(word.x)), *(self.of_z[place] for place in bits(word.z))):
            x, z = x ^ part.x, z ^ part.z
        return Word(x, z, 0)

    def turn(self, word: Word) -> None:
        """Adds a quarter turn about a word: what does not commute with it is multiplied by it."""
        own = self.image(word)
        for images, met in ((self.of_x, word.z), (self.of_z, word.x)):
            for place in bits(met):
                images[place] = Word(images[place].x ^ own.x, images[place].z ^ own.z, 0)
