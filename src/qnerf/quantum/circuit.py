"""Circuits by name, and everything that a description of a circuit consists of.

`ANSATZE` holds the circuits that have a name. A new one is a function of the wires and the spectral layers that
returns a `Circuit`; its keyword-only parameters are options that a configuration can set:

    @ANSATZE.register("mine")
    def mine(wires: int, spectral: int, *, axis: str = "Y") -> Circuit:
        return reuploading("mine", wires, spectral, entangler="CNOT", ranges=(1, 1), axis=axis)
"""

from dataclasses import replace
from typing import Annotated, Any, Literal

from annotated_types import Interval

from qnerf.config.bounds import Factor
from qnerf.config.registry import Registry
from qnerf.quantum.description import (
    ENTANGLING_GATES,
    MAX_SPECTRAL,
    MAX_STATE_WIRES,
    MAX_WIRES,
    PAULIS,
    Circuit,
    Encoding,
    Entangler,
    EntanglingGate,
    Hamiltonian,
    Observable,
    Operation,
    Pauli,
    PauliWord,
    Probabilities,
    Rotations,
    Spectral,
    Wires,
    as_sum,
    check_state,
    check_wires,
    readable_bytes,
    values_of,
)
from qnerf.quantum.expressions import Expression, Weights, feature, weight
from qnerf.quantum.gates import GATES, Amplitudes, Gate

__all__ = [
    "ANSATZE", "ENTANGLING_GATES", "GATES", "MAX_SPECTRAL", "MAX_STATE_WIRES", "MAX_WIRES", "PAULIS", "Amplitudes",
    "Circuit", "Encoding", "Entangler", "EntanglingGate", "Expression", "Gate", "Hamiltonian", "Observable",
    "Operation", "Pauli", "PauliWord", "Probabilities", "Rotations", "Spectral", "Weights", "Wires", "as_sum",
    "check_state", "check_wires", "feature", "readable_bytes", "reuploading", "ring", "values_of", "weight",
]  # fmt: skip


def ring(wires: int, distance: int) -> tuple[tuple[int, int], ...]:
    """Pairs (i, (i + distance) mod n) for every wire i; no pair for a single wire.

    >>> ring(4, 1)
    ((0, 1), (1, 2), (2, 3), (3, 0))
    """
    if wires == 1:
        return ()
    return tuple((i, (i + distance) % wires) for i in range(wires))


ANSATZE: Registry[Circuit] = Registry("ansatz")


@ANSATZE.register("qiren")
def qiren(
    wires: int,
    spectral: int,
    *,
    sublayers: Annotated[int, Interval(ge=1, le=32)] = 2,
    entangler: EntanglingGate = "CZ",
    ranges: tuple[Annotated[int, Interval(ge=-MAX_SPECTRAL, le=MAX_SPECTRAL)], ...] | None = None,
    axis: Pauli = "Z",
    scaling: Literal["unit", "ternary"] = "unit",
    scale: Factor = 1.0,
    observable: Pauli = "Z",
) -> Circuit:
    """QIREN (Zhao et al., arXiv:2406.03873): RZ encodings between StronglyEntanglingLayers with CZ, <Z> on every wire.

    S times a trainable block and an encoding, then one closing block. With 3 wires and S = 1:

        0: ──Rot─╭●────╭Z──Rot─╭●─╭Z──RZ──Rot──────╭●────╭Z──Rot─╭●─╭Z────┤  <Z>
        1: ──Rot─╰Z─╭●─│───Rot─│──╰●─╭Z───RZ───Rot─╰Z─╭●─│───Rot─│──╰●─╭Z─┤  <Z>
        2: ──Rot────╰Z─╰●──Rot─╰Z────╰●───RZ───Rot────╰Z─╰●──Rot─╰Z────╰●─┤  <Z>

    Args:
        wires: n, 1 to 1024.
        spectral: S, the encodings of the input, at least 1.
        sublayers: of each trainable block; each is Rot on every wire and a ring of entanglers.
        entangler: CZ or CNOT.
        ranges: the distance of the ring in each sublayer l. None takes 1 + (l mod (n - 1)), as PennyLane's
            StronglyEntanglingLayers does.
        axis: of the encodings: X, Y or Z.
        scaling: unit gives every encoding the same scale. ternary scales encoding s by 3^s, which makes the 3^S
            frequencies of a wire all different (Shin et al., arXiv:2206.12105).
        scale: a factor on every encoding angle.
        observable: the Pauli letter that every wire is measured in.

    Raises:
        ValueError: an option is unknown, or a ring's distance is a multiple of the number of wires.
    """
    check_wires(wires)
    distances = ranges or tuple(1 + (layer % (wires - 1)) if wires > 1 else 0 for layer in range(sublayers))
    if len(distances) != sublayers or (wires > 1 and any(distance % wires == 0 for distance in distances)):
        raise ValueError(f"ranges needs {sublayers} distances, none a multiple of {wires}, got {distances}")
    operations: list[Operation] = []
    for block in range(spectral + 1):
        for layer in range(sublayers):
            operations.append(Rotations(block * sublayers + layer))
            operations.append(Entangler(entangler, ring(wires, distances[layer])))
        if block < spectral:
            factor = scale * (3.0**block if scaling == "ternary" else 1.0)
            operations.append(Encoding(axis, (factor,) * wires))
    observables = tuple(((wire, observable),) for wire in range(wires))
    return Circuit("qiren", wires, spectral, sublayers, tuple(operations), observables)


def reuploading(name: str, wires: int, spectral: int, **options: Any) -> Circuit:
    """A circuit of QIREN's family: `qiren` with other options, under a name of its own."""
    return replace(qiren(wires, spectral, **options), name=name)


@ANSATZE.register("cnot")
def cnot(wires: int, spectral: int) -> Circuit:
    """QIREN with CNOT, which StronglyEntanglingLayers takes by default.

    0: ──Rot─╭●────╭X──Rot─╭●─╭X──RZ──Rot──────╭●────╭X──Rot─╭●─╭X────┤  <Z>
    1: ──Rot─╰X─╭●─│───Rot─│──╰●─╭X───RZ───Rot─╰X─╭●─│───Rot─│──╰●─╭X─┤  <Z>
    2: ──Rot────╰X─╰●──Rot─╰X────╰●───RZ───Rot────╰X─╰●──Rot─╰X────╰●─┤  <Z>
    """
    return reuploading("cnot", wires, spectral, entangler="CNOT")


@ANSATZE.register("neighbours")
def neighbours(wires: int, spectral: int) -> Circuit:
    """QIREN with both rings at distance 1, which narrows the light cones.

    0: ──Rot─╭●────╭Z──Rot─╭●────╭Z──RZ──Rot─╭●────╭Z──Rot─╭●────╭Z─┤  <Z>
    1: ──Rot─╰Z─╭●─│───Rot─╰Z─╭●─│───RZ──Rot─╰Z─╭●─│───Rot─╰Z─╭●─│──┤  <Z>
    2: ──Rot────╰Z─╰●──Rot────╰Z─╰●──RZ──Rot────╰Z─╰●──Rot────╰Z─╰●─┤  <Z>
    """
    return reuploading("neighbours", wires, spectral, ranges=(1, 1))


@ANSATZE.register("ternary")
def ternary(wires: int, spectral: int) -> Circuit:
    """QIREN with encoding s = 0, 1, ... scaled by 3^s: 3^S frequencies a wire instead of 2 S + 1.

    With S = 1 it is `qiren`; the encodings of S = 2 are RZ(x_j) and RZ(3 x_j).

        0: ──Rot─╭●────╭Z──Rot─╭●─╭Z──RZ──Rot──────╭●────╭Z──Rot─╭●─╭Z────┤  <Z>
        1: ──Rot─╰Z─╭●─│───Rot─│──╰●─╭Z───RZ───Rot─╰Z─╭●─│───Rot─│──╰●─╭Z─┤  <Z>
        2: ──Rot────╰Z─╰●──Rot─╰Z────╰●───RZ───Rot────╰Z─╰●──Rot─╰Z────╰●─┤  <Z>
    """
    return reuploading("ternary", wires, spectral, scaling="ternary")


@ANSATZE.register("rx")
def rx(wires: int, spectral: int) -> Circuit:
    """QIREN with RX encodings.

    0: ──Rot─╭●────╭Z──Rot─╭●─╭Z──RX──Rot──────╭●────╭Z──Rot─╭●─╭Z────┤  <Z>
    1: ──Rot─╰Z─╭●─│───Rot─│──╰●─╭Z───RX───Rot─╰Z─╭●─│───Rot─│──╰●─╭Z─┤  <Z>
    2: ──Rot────╰Z─╰●──Rot─╰Z────╰●───RX───Rot────╰Z─╰●──Rot─╰Z────╰●─┤  <Z>
    """
    return reuploading("rx", wires, spectral, axis="X")


@ANSATZE.register("ry")
def ry(wires: int, spectral: int) -> Circuit:
    """QIREN with RY encodings.

    0: ──Rot─╭●────╭Z──Rot─╭●─╭Z──RY──Rot──────╭●────╭Z──Rot─╭●─╭Z────┤  <Z>
    1: ──Rot─╰Z─╭●─│───Rot─│──╰●─╭Z───RY───Rot─╰Z─╭●─│───Rot─│──╰●─╭Z─┤  <Z>
    2: ──Rot────╰Z─╰●──Rot─╰Z────╰●───RY───Rot────╰Z─╰●──Rot─╰Z────╰●─┤  <Z>
    """
    return reuploading("ry", wires, spectral, axis="Y")


@ANSATZE.register("pauli_x")
def pauli_x(wires: int, spectral: int) -> Circuit:
    """QIREN measured in X instead of Z. The last ring then has an effect; a Z measurement would not see it.

    0: ──Rot─╭●────╭Z──Rot─╭●─╭Z──RZ──Rot──────╭●────╭Z──Rot─╭●─╭Z────┤  <X>
    1: ──Rot─╰Z─╭●─│───Rot─│──╰●─╭Z───RZ───Rot─╰Z─╭●─│───Rot─│──╰●─╭Z─┤  <X>
    2: ──Rot────╰Z─╰●──Rot─╰Z────╰●───RZ───Rot────╰Z─╰●──Rot─╰Z────╰●─┤  <X>
    """
    return reuploading("pauli_x", wires, spectral, observable="X")
