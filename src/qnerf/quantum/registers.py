"""A wide re-uploading circuit as registers: circuits of few wires that together have the same outputs, exactly.

An expectation value depends on the wires in its light cone alone (`cones.trace`). So a state of the cone's wires is
enough, however wide the circuit is. An output whose wires another output has too shares its register.

>>> from qnerf.quantum.circuit import ANSATZE
>>> parts = registers(ANSATZE.build("qiren", 64, 1))
>>> len(parts), max(part.circuit.wires for part in parts)
(64, 9)
"""

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

from qnerf.quantum.circuit import Circuit, Encoding, Entangler, Operation, check_state
from qnerf.quantum.cones import trace

SMALL = 6  # wires: cones join one register up to here, because a smaller state saves nothing
WHOLE = 10  # wires: circuits up to here stay one


class Register(NamedTuple):
    """Some outputs of a circuit, as the outputs of a circuit of its own on some of the wires, in this order."""

    circuit: Circuit
    wires: tuple[int, ...]
    outputs: tuple[int, ...]


@lru_cache(maxsize=256)
def is_split(circuit: Circuit) -> bool:
    """Whether the circuit runs as registers: it is wide, and their states are at most half as large together.

    Raises:
        ValueError: the largest state that it needs has more than 20 wires.
    """
    parts = registers(circuit) if circuit.reuploading and circuit.wires > WHOLE else ()
    if parts and sum(2.0 ** len(part.wires) for part in parts) <= 2.0 ** (circuit.wires - 1):
        largest = len(parts[0].wires)
        check_state(largest, f"an output of circuit {circuit.name} depends on {largest} of its {circuit.wires} wires")
        return True
    check_state(circuit.wires, f"circuit {circuit.name}")
    return False


@lru_cache(maxsize=64)
def registers(circuit: Circuit) -> tuple[Register, ...]:
    """The registers of a re-uploading circuit, the largest first."""
    cones = [(trace(circuit, word).wires or {0}, output) for output, word in enumerate(circuit.words)]
    joined: list[tuple[set[int], list[int]]] = []
    for cone, output in sorted(cones, key=lambda cone: -len(cone[0])):
        for wires, outputs in joined:
            if len(wires | cone) <= max(len(wires), SMALL):
                wires.update(cone)
                outputs.append(output)
                break
        else:
            joined.append((set(cone), [output]))
    return tuple(_register(circuit, tuple(sorted(wires)), tuple(outputs)) for wires, outputs in joined)


def _register(circuit: Circuit, wires: tuple[int, ...], outputs: tuple[int, ...]) -> Register:
    number = {wire: index for index, wire in enumerate(wires)}

    def restricted(operation: Operation) -> Operation:
        if isinstance(operation, Encoding):
            return Encoding(operation.axis, tuple(operation.scales[wire] for wire in wires))
        if isinstance(operation, Entangler):
            pairs = tuple((number[a], number[b]) for a, b in operation.pairs if a in number and b in number)
            return Entangler(operation.gate, pairs)
        return operation

    words = tuple(tuple((number[wire], letter) for wire, letter in circuit.words[output]) for output in outputs)
    operations = tuple(map(restricted, circuit.operations))
    own = replace(circuit, wires=len(wires), features=None, operations=operations, observables=words)
    return Register(own, wires, outputs)
