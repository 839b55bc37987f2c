"""A wide circuit as registers: circuits of few wires that together have the same outputs, exactly.

An expectation value depends on the wires in its light cone alone (`cones.trace`). So a state of the cone's wires is
enough, however wide the circuit is. An output whose wires another output has too shares its register.

>>> from qnerf.quantum.circuit import ANSATZE
>>> parts = registers(ANSATZE.build("qiren", 64, 1))
>>> len(parts), max(part.circuit.wires for part in parts)
(64, 9)
"""

from collections.abc import Iterable
from functools import lru_cache
from typing import NamedTuple

from qnerf.quantum.angles import offsets
from qnerf.quantum.basis import bit
from qnerf.quantum.circuit import Circuit, Hamiltonian, Observable, PauliWord, Probabilities, check_state, values_of
from qnerf.quantum.cones import trace
from qnerf.quantum.expressions import Expression, Weights
from qnerf.quantum.gates import Amplitudes, Gate
from qnerf.quantum.one_wire import half_turns
from qnerf.quantum.program import program

SMALL = 6  # wires: cones join one register up to here, because a smaller state saves nothing
WHOLE = 10  # wires: circuits up to here stay one


class Register(NamedTuple):
    """Some outputs of a circuit, as the outputs of a circuit of its own.

    Attributes:
        circuit: on some of the wires.
        features, weights: the features, and the places among the flat weights, that it takes, in this order.
        outputs: of the whole circuit, in the order of its own.
    """

    circuit: Circuit
    features: tuple[int, ...]
    weights: tuple[int, ...]
    outputs: tuple[int, ...]


@lru_cache(maxsize=256)
def is_split(circuit: Circuit) -> bool:
    """Whether the circuit runs as registers: it is wide, and their states are at most half as large together.

    Raises:
        ValueError: the largest state that it needs has more than 20 wires.
    """
    parts = registers(circuit) if circuit.wires > WHOLE else ()
    if parts and sum(2.0**part.circuit.wires for part in parts) <= 2.0 ** (circuit.wires - 1):
        largest = parts[0].circuit.wires
        check_state(largest, f"an output of circuit {circuit.name} depends on {largest} of its {circuit.wires} wires")
        return True
    check_state(circuit.wires, f"circuit {circuit.name}")
    return False


@lru_cache(maxsize=64)
def registers(circuit: Circuit) -> tuple[Register, ...]:
    """The registers of a circuit, the largest first."""
    n = circuit.wires
    found: list[tuple[set[int], Observable, tuple[int, ...]]] = []
    first = 0
    own = program(circuit)
    for observable, words in zip(circuit.observables, own.observed, strict=True):
        x = z = 0
        for word in words:
            x, z = x | word.x, z | word.z
        mask = trace(own, x, z).wires
        wires = {wire for wire in range(n) if mask & bit(wire, n)} or {0}
        for part in circuit.operations:
            if isinstance(part, Amplitudes) and wires & set(part.wires):
                wires |= set(part.wires)
        found.append((wires, observable, tuple(range(first, first + values_of(observable)))))
        first += values_of(observable)
    joined: list[tuple[set[int], list[Observable], list[int]]] = []
    for cone, observable, outputs in sorted(found, key=lambda each: -len(each[0])):
        for wires, observables, places in joined:
            if len(wires | cone) <= max(len(wires), SMALL):
                wires.update(cone)
                observables.append(observable)
                places.extend(outputs)
                break
        else:
            joined.append((set(cone), [observable], list(outputs)))
    return tuple(_register(circuit, tuple(sorted(wires)), seen, places) for wires, seen, places in joined)


class _Restricted:
    """A circuit's gates, features and weights as those of a circuit on some of its wires."""

    def __init__(self, wires: tuple[int, ...]) -> None:
        self.number = {wire: index for index, wire in enumerate(wires)}
        self.features: dict[int, int] = {}
        self.weights: dict[tuple[str, int], int] = {}

    def operation(self, operation: Gate | Amplitudes) -> list[Gate | Amplitudes]:
        wires = [wire for wire in operation.wires if wire in self.number]
        own = tuple(self.number[wire] for wire in wires)
        if isinstance(operation, Amplitudes):
            real, imaginary = (tuple(map(self.angle, part)) for part in (operation.real, operation.imaginary))
            return [Amplitudes(own, real, imaginary)] if wires else []
        if len(wires) == len(operation.wires):
            return [Gate(operation.name, own, tuple(map(self.angle, operation.angles)), operation.word)]
        # Only Pauli words reach from outside into a cone, as a rotation by pi does; everything else has no effect here.
        found: list[Gate | Amplitudes] = []
        for part in operation.rotations if wires else ():
            angle = operation.angle_of(part)
            word = "".join(c for c, wire in zip(part.letters, operation.wires, strict=True) if wire in self.number)
            if (half_turns(angle) or 0) % 2 and set(word) != {"I"}:
                found.append(Gate("PauliRot", own, (angle,), word))
        return found

    def angle(self, angle: Expression | float) -> Expression:
        return Expression(tuple(
            (
                factor,
                tuple(("weights", self.weights.setdefault(weight, len(self.weights))) for weight in weights),
                tuple(self.features.setdefault(feature, len(self.features)) for feature in features),
            )
            for factor, weights, features in Expression.of(angle).terms
        ))  # fmt: skip


def _register(
    circuit: Circuit, wires: tuple[int, ...], observables: Iterable[Observable], outputs: Iterable[int]
) -> Register:
    own = _Restricted(wires)

    def observed(observable: Observable) -> Observable:
        if isinstance(observable, Probabilities):
            return Probabilities(tuple(own.number[wire] for wire in observable.wires))
        if isinstance(observable, Hamiltonian):
            return Hamiltonian(observable.coefficients, tuple(map(word, observable.words)))
        return word(observable)

    def word(word: PauliWord) -> PauliWord:
        return tuple((own.number[wire], letter) for wire, letter in word)

    operations = tuple(part for operation in circuit.operations for part in own.operation(operation))
    weights = (Weights("weights", (len(own.weights),)),) if own.weights else ()
    part = Circuit("register", len(wires), operations, tuple(map(observed, observables)), len(own.features), weights)
    first = offsets(circuit.parameters)
    places = tuple(first[name] + index for name, index in own.weights)
    return Register(part, tuple(own.features), places, tuple(outputs))
