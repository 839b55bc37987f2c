"""A wide circuit as registers: circuits of few wires that together have the same outputs, exactly.

An expectation value depends on the gates in its light cone alone (`cones.trace`). So a state of the cone's wires is
enough, however wide the circuit is. Outputs whose wires lie within those of another one share its register. In a ring,
most registers are copies: the same circuit with other features and weights.

>>> from qnerf.quantum.circuit import ANSATZE
>>> wide = ANSATZE.build("qiren", 64, 1)
>>> parts = block_registers(wide)
>>> len(parts), len({part.circuit for part in parts}), parts[0].circuit.wires
(64, 1, 9)
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from qnerf.quantum.circuit import (
    MAX_STATE_WIRES,
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
    feature,
    values_of,
    weight,
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
        wires: of the whole circuit, in this order.
        features: of the whole circuit's input, in this order.
        weights: of the whole circuit's flat weights, in this order.
        values: which of the `measured` values it has, in this order.
    """

    circuit: Circuit
    wires: tuple[int, ...]
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


def state_wires(circuit: Circuit) -> int:
    """Wires of the largest state that the circuit needs."""
    return max(len(part.wires) for part in _joined_cones(circuit)) if is_split(circuit) else circuit.wires


def as_registers(circuit: Circuit) -> str:
    """
    >>> from qnerf.quantum.circuit import ANSATZE
    >>> as_registers(ANSATZE.build("qiren", 64, 1))
    '64 registers of at most 9 wires'
    """
    return f"{len(_joined_cones(circuit))} registers of at most {state_wires(circuit)} wires"


@lru_cache(maxsize=256)
def measured(circuit: Circuit) -> Measured:
    """The values that the outputs of a circuit are made of."""
    index: dict[PauliWord | Probabilities, int] = {}
    places: list[int] = []
    entries: list[tuple[int, int, float]] = []
    values = output = 0

    def place(observable: PauliWord | Probabilities, size: int) -> int:
        nonlocal values
        if observable not in index:
            index[observable] = values
            places.append(values)
            values += size
        return index[observable]

    constants = np.zeros(circuit.outputs)
    for observable in circuit.observables:
        if isinstance(observable, Probabilities):
            size = values_of(observable)
            first = place(observable, size)
            entries += [(output + k, first + k, 1.0) for k in range(size)]
            output += size
            continue
        sums = as_sum(observable)
        for coefficient, word in zip(sums.coefficients, sums.words, strict=True):
            if word:
                entries.append((output, place(tuple(sorted(word)), 1), coefficient))
            else:
                constants[output] += coefficient
        output += 1
    combination = np.zeros((output, values))
    for row, column, coefficient in entries:
        combination[row, column] += coefficient
    are_values = output == values and not constants.any() and np.array_equal(combination, np.eye(values))
    return Measured(tuple(index), tuple(places), values, None if are_values else combination, constants)


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


class _Part(NamedTuple):
    """A register to be: its wires and their numbers in it, what it measures, and which of the `measured` values."""

    gates: list[int]
    order: tuple[int, ...]
    number: dict[int, int]
    observables: tuple[PauliWord | Probabilities, ...]
    values: tuple[int, ...]


def _parts(circuit: Circuit) -> Iterator[_Part]:
    found = measured(circuit)
    for cone in _joined_cones(circuit):
        order = _in_ring_order(cone.wires, circuit.wires)
        number = {wire: index for index, wire in enumerate(order)}
        values: list[int] = []
        observables: list[PauliWord | Probabilities] = []
        for observable, first in ((found.observables[place], found.places[place]) for place in cone.observables):
            values += range(first, first + values_of(observable))
            if isinstance(observable, Probabilities):
                observables.append(Probabilities(tuple(number[wire] for wire in observable.wires)))
            else:
                observables.append(tuple((number[wire], letter) for wire, letter in observable))
        yield _Part(sorted(cone.gates), order, number, tuple(observables), tuple(values))


@lru_cache(maxsize=64)
def block_registers(circuit: Circuit) -> tuple[Register, ...]:
    """The registers of a re-uploading circuit: re-uploading circuits with its operations on some of the wires."""
    registers = []
    for _, order, number, observables, values in _parts(circuit):
        operations = tuple(_restricted(operation, order, number) for operation in circuit.operations)
        own = replace(circuit, wires=len(order), features=None, operations=operations, observables=observables)
        weights = np.arange(circuit.size).reshape(circuit.rows, -1, 3)[:, order].ravel().tolist()
        registers.append(Register(own, order, order, tuple(weights), values))
    return tuple(registers)


@lru_cache(maxsize=64)
def gate_registers(circuit: Circuit) -> tuple[Register, ...]:
    """The registers of any circuit: the gates of a cone, with the features and weights that they use."""
    registers = []
    for gates, order, number, observables, values in _parts(circuit):
        renumbered = _Renumbered(circuit)
        operations = tuple(renumbered(gates_of(circuit)[place][1], number) for place in gates)
        weights = (Weights("weights", (len(renumbered.weights),)),) if renumbered.weights else ()
        features = len(renumbered.features)
        own = Circuit(circuit.name, len(order), 0, 0, operations, observables, features, weights)
        registers.append(Register(own, order, tuple(renumbered.features), tuple(renumbered.weights), values))
    return tuple(registers)


def _in_ring_order(wires: Iterable[int], n: int) -> tuple[int, ...]:
    """The wires in order, from the one after the largest gap: neighbours in a ring stay neighbours."""
    order = sorted(wires)
    gaps = [(wire - before) % n for before, wire in zip([order[-1], *order[:-1]], order, strict=True)]
    first = gaps.index(max(gaps))
    return tuple(order[first:] + order[:first])


def _restricted(operation: Operation, order: tuple[int, ...], number: dict[int, int]) -> Operation:
    """A re-uploading circuit's operation on some of its wires."""
    if isinstance(operation, Encoding):
        return Encoding(operation.axis, tuple(operation.scales[wire] for wire in order))
    if isinstance(operation, Entangler):
        pairs = [(number[a], number[b]) for a, b in operation.pairs if a in number and b in number]
        return Entangler(operation.gate, tuple(sorted(pairs) if operation.gate == "CZ" else pairs))
    assert isinstance(operation, Rotations)
    return operation


class _Renumbered:
    """Gates with the features and weights that they use numbered in the order in which they come."""

    def __init__(self, circuit: Circuit) -> None:
        self.first = offsets(circuit.parameters)
        self.features: dict[int, int] = {}
        self.weights: dict[int, int] = {}

    def __call__(self, gate: Gate | Amplitudes, number: dict[int, int]) -> Gate | Amplitudes:
        wires = tuple(number[wire] for wire in gate.wires)
        if isinstance(gate, Amplitudes):
            return Amplitudes(wires, *(tuple(map(self._angle, part)) for part in (gate.real, gate.imaginary)))
        return Gate(gate.name, wires, tuple(map(self._angle, gate.angles)), gate.word)

    def _angle(self, angle: Expression | float) -> Expression:
        total = Expression()
        for coefficient, weights, features in Expression.of(angle).terms:
            term = Expression.of(coefficient)
            for name, index in weights:
                flat = self.first[name] + index
                term = term * weight("weights", self.weights.setdefault(flat, len(self.weights)))
            for index in features:
                term = term * feature(self.features.setdefault(index, len(self.features)))
            total = total + term
        return total


assert SMALL <= WHOLE <= MAX_STATE_WIRES
