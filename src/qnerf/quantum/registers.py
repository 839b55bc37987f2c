"""A wide circuit as registers: circuits of few wires that together have the same outputs, exactly.

An expectation value depends on the gates in its light cone alone (`cones.trace`). So a state of the cone's wires is
enough, however wide the circuit is. Outputs whose wires lie within those of another one share its register.

>>> from qnerf.quantum.circuit import ANSATZE
>>> parts = registers(ANSATZE.build("qiren", 64, 1))
>>> len(parts), max(part.circuit.wires for part in parts)
(64, 9)
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from qnerf.quantum.circuit import (
    Amplitudes,
    Circuit,
    Encoding,
    Entangler,
    Expression,
    Gate,
    Operation,
    PauliWord,
    Probabilities,
    Rotations,
    Weights,
    as_sum,
    check_state,
    values_of,
)
from qnerf.quantum.cones import gates_of, trace
from qnerf.quantum.expression_table import offsets

SMALL = 6  # wires: cones join one register up to here, because a smaller state saves nothing
WHOLE = 10  # wires: circuits up to here stay one


@dataclass(frozen=True)
class Register:
    """Some values of a circuit, as the outputs of a circuit of its own.

    Attributes:
        circuit: on the register's wires, which are numbered from 0, as are its features and weights.
        features: of the whole circuit's input, in this order.
        weights: of the whole circuit's flat weights, in this order.
        values: which of the `measured` values it has, in this order.
    """

    circuit: Circuit
    features: tuple[int, ...]
    weights: tuple[int, ...]
    values: tuple[int, ...]


@dataclass(frozen=True)
class Measured:
    """What is measured one by one: the words and the probabilities that a circuit's outputs are made of.

    Attributes:
        observables: Pauli words and `Probabilities`, all different.
        places: of each observable, its first value.
        values: how many values they have together.
        combination: (outputs, values); outputs = combination @ values + constants. None where the outputs are the
            values.
        constants: (outputs,).
    """

    observables: tuple[PauliWord | Probabilities, ...]
    places: tuple[int, ...]
    values: int
    combination: np.ndarray | None
    constants: np.ndarray

    def outputs(self, values: Tensor) -> Tensor:
        """Outputs (B, outputs) for values (B, values)."""
        if self.combination is None:
            return values
        return values @ torch.from_numpy(self.combination).to(values).T + torch.from_numpy(self.constants).to(values)


@lru_cache(maxsize=256)
def is_split(circuit: Circuit) -> bool:
    """Whether the circuit runs as registers: it is wide, and their states are at most half as large together.

    Raises:
        ValueError: the largest state that it needs has more than 20 wires.
    """
    parts = _joined_cones(circuit) if circuit.wires > WHOLE else ()
    if not parts:
        return False
    largest = max(len(part.wires) for part in parts)
    if sum(2.0 ** len(part.wires) for part in parts) <= 2.0 ** (circuit.wires - 1):
        check_state(largest, f"an output of circuit {circuit.name} depends on {largest} of its {circuit.wires} wires")
        return True
    check_state(circuit.wires, f"circuit {circuit.name}")
    return False


@lru_cache(maxsize=256)
def measured(circuit: Circuit) -> Measured:
    """The values that the outputs of a circuit are made of."""
    places: dict[PauliWord | Probabilities, int] = {}
    entries: list[tuple[int, int, float]] = []
    constants = np.zeros(circuit.outputs)
    values = output = 0
    for observable in circuit.observables:
        size = values_of(observable)
        terms: list[tuple[PauliWord | Probabilities, float]]
        if isinstance(observable, Probabilities):
            terms = [(observable, 1.0)]
        else:
            sums = as_sum(observable)
            terms = [(tuple(sorted(word)), c) for word, c in zip(sums.words, sums.coefficients, strict=True)]
        for part, coefficient in terms:
            if not part:
                constants[output] += coefficient
                continue
            first = places.setdefault(part, values)
            values = max(values, first + size)
            entries += [(output + k, first + k, coefficient) for k in range(size)]
        output += size
    combination = np.zeros((output, values))
    for row, column, coefficient in entries:
        combination[row, column] += coefficient
    are_values = output == values and not constants.any() and np.array_equal(combination, np.eye(values))
    return Measured(tuple(places), tuple(places.values()), values, None if are_values else combination, constants)


class _Cone(NamedTuple):
    """Light cones that share a register: their wires, their gates' places in `gates_of`, and their observables."""

    wires: set[int]
    gates: set[int]
    observables: list[int]


@lru_cache(maxsize=64)
def _joined_cones(circuit: Circuit) -> tuple[_Cone, ...]:
    """The cones of all measured values, the largest first; smaller ones join those that hold their wires."""
    cones = []
    for place, observable in enumerate(measured(circuit).observables):
        if isinstance(observable, Probabilities):
            observable = tuple((wire, "Z") for wire in observable.wires)
        cones.append((trace(circuit, observable), place))
    joined: list[_Cone] = []
    for cone, place in sorted(cones, key=lambda cone: -len(cone[0].wires)):
        for other in joined:
            if len(other.wires | cone.wires) <= max(len(other.wires), SMALL):
                other.wires.update(cone.wires)
                other.gates.update(cone.gates)
                other.observables.append(place)
                break
        else:
            joined.append(_Cone(set(cone.wires), set(cone.gates), [place]))
    return tuple(joined)


@lru_cache(maxsize=64)
def registers(circuit: Circuit) -> tuple[Register, ...]:
    """The registers, that of the largest cone first.

    Those of a re-uploading circuit are re-uploading circuits with its operations on some of the wires. Those of any
    other circuit have the gates of a cone, and all features and weights.
    """
    found, first = measured(circuit), offsets(circuit.parameters)
    made = []
    for cone in _joined_cones(circuit):
        order = tuple(sorted(cone.wires))
        number = {wire: index for index, wire in enumerate(order)}
        measures = tuple(_renumbered(found.observables[place], number) for place in cone.observables)
        values = [found.places[k] + j for k in cone.observables for j in range(values_of(found.observables[k]))]
        if circuit.reuploading:
            operations = tuple(_restricted(operation, order, number) for operation in circuit.operations)
            own = replace(circuit, wires=len(order), features=None, operations=operations, observables=measures)
            features = order
            weights = tuple(np.arange(circuit.size).reshape(circuit.rows, -1, 3)[:, order].ravel().tolist())
        else:
            features, weights = tuple(range(circuit.features or 0)), tuple(range(circuit.size))
            gates = tuple(_moved(gates_of(circuit)[place][1], number, first) for place in sorted(cone.gates))
            flat = (Weights("weights", (circuit.size,)),) if circuit.size else ()
            own = Circuit(circuit.name, len(order), 0, 0, gates, measures, circuit.features, flat)
        made.append(Register(own, features, weights, tuple(values)))
    return tuple(made)


def _renumbered(observable: PauliWord | Probabilities, number: dict[int, int]) -> PauliWord | Probabilities:
    if isinstance(observable, Probabilities):
        return Probabilities(tuple(number[wire] for wire in observable.wires))
    return tuple((number[wire], letter) for wire, letter in observable)


def _restricted(operation: Operation, order: tuple[int, ...], number: dict[int, int]) -> Operation:
    """A re-uploading circuit's operation on some of its wires."""
    if isinstance(operation, Encoding):
        return Encoding(operation.axis, tuple(operation.scales[wire] for wire in order))
    if isinstance(operation, Entangler):
        pairs = tuple((number[a], number[b]) for a, b in operation.pairs if a in number and b in number)
        return Entangler(operation.gate, pairs)
    assert isinstance(operation, Rotations)
    return operation


def _moved(gate: Gate | Amplitudes, number: dict[int, int], first: dict[str, int]) -> Gate | Amplitudes:
    """The gate on other wires, with flat weights."""

    def flat(values: tuple[Expression | float, ...]) -> tuple[Expression, ...]:
        return tuple(Expression.of(value).with_flat_weights("weights", first) for value in values)

    wires = tuple(number[wire] for wire in gate.wires)
    if isinstance(gate, Amplitudes):
        return Amplitudes(wires, flat(gate.real), flat(gate.imaginary))
    return Gate(gate.name, wires, flat(gate.angles), gate.word)
