"""Light cones: which inputs each output of a circuit depends on.

An output is a trigonometric polynomial of the inputs in its cone (arXiv:2008.08605): an encoding with scale s adds
{-s, 0, s} to the frequencies of its wire. The cone is found by carrying the observable back through the circuit
(Heisenberg picture). Two bits for each wire are tracked: may the observable act there as X or Y, and as Z or Y? A cone
may therefore come out too large, never too small. The gates and wires that the observable never meets can be left out
(`registers`).

>>> from qnerf.quantum.circuit import ANSATZE
>>> cone = find_cones(ANSATZE.build("qiren", 8, 1)).cones[1]
>>> cone.wires, cone.coefficients
((0, 1, 2), 27)
"""

from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from math import gcd, lcm, prod
from typing import NamedTuple

from qnerf.quantum.circuit import Amplitudes, Circuit, Encoding, Gate, PauliWord
from qnerf.quantum.pauli_form import Word, as_gates, clifford_frame

MAX_COEFFICIENTS = 1024  # of one output: beyond that a state vector is cheaper


@dataclass(frozen=True)
class Cone:
    """The inputs of one output. The frequencies of `wires[i]` are 0, 1, ..., `degrees[i]` times its base frequency."""

    wires: tuple[int, ...]
    degrees: tuple[int, ...]

    @property
    def coefficients(self) -> int:
        """Real coefficients of the polynomial, prod (2 degree + 1)."""
        return prod(2 * degree + 1 for degree in self.degrees)


@dataclass(frozen=True)
class Cones:
    """The cone of each output, and the base frequency of each wire (1 / radians; 0 if the wire has no encoding)."""

    cones: tuple[Cone, ...]
    base_frequencies: tuple[float, ...]


class TooLarge(ValueError):
    """The circuit has no light cones that are small enough for polynomials."""


@lru_cache(maxsize=256)
def find_cones(circuit: Circuit) -> Cones:
    """The cones of all outputs.

    Raises:
        TooLarge: an output has more than `MAX_COEFFICIENTS` coefficients, the encoding scales of a wire are not
            multiples of one frequency, or the circuit does not re-upload data.
    """
    if not circuit.reuploading:
        raise TooLarge(f"lightcone: ansatz {circuit.name} does not re-upload data; choose method=auto")
    met = [_encodings_met(circuit, word) for word in circuit.words]
    base = tuple(_base_frequency(circuit, wire) for wire in range(circuit.wires))
    cones = []
    for output, scales in enumerate(met):
        degrees = {}
        for wire, values in sorted(scales.items()):
            degree = round(sum(abs(value) for value in values) / base[wire]) if base[wire] else 0
            if degree:
                degrees[wire] = degree
        cone = Cone(tuple(degrees), tuple(degrees.values()))
        if cone.coefficients > MAX_COEFFICIENTS:
            raise TooLarge(
                f"lightcone: output {output} of ansatz {circuit.name} with {circuit.wires} wires and {circuit.spectral}"
                f" spectral layers depends on {len(cone.wires)} inputs through {cone.coefficients} coefficients, more"
                f" than {MAX_COEFFICIENTS}; choose method=statevector or auto"
            )
        cones.append(cone)
    return Cones(tuple(cones), base)


def _encodings_met(circuit: Circuit, word: PauliWord) -> dict[int, list[float]]:
    """For each wire, the scales of the encodings that do not commute with the observable on its way back."""
    met: dict[int, list[float]] = {}
    gates = gates_of(circuit)
    for place, gate in (gates[index] for index in sorted(trace(circuit, word).gates)):
        operation = circuit.operations[place]
        if isinstance(operation, Encoding):
            met.setdefault(gate.wires[0], []).append(operation.scales[gate.wires[0]])
    return met


class Trace(NamedTuple):
    """What an observable meets on its way back to the start of a circuit.

    Attributes:
        wires: that it may act on at some time; no others have an effect on its expectation value.
        gates: places in `gates_of` of the gates that may change it. It is unchanged by the others.
    """

    wires: frozenset[int]
    gates: frozenset[int]


def trace(circuit: Circuit, letters: Iterable[tuple[int, str]]) -> Trace:
    """The light cone of a product of Pauli letters, (wire, letter) each. A wire may be given several letters."""
    x, z = set[int](), set[int]()
    for wire, letter in letters:
        if letter in "XY":
            x.add(wire)
        if letter in "ZY":
            z.add(wire)
    wires, gates = x | z, set()
    for place, (_, gate) in reversed(list(enumerate(gates_of(circuit)))):
        if x.isdisjoint(gate.wires) and z.isdisjoint(gate.wires):
            continue
        if isinstance(gate, Amplitudes):  # the state of these wires is one whole
            wires.update(gate.wires)
        elif not _carry_back(gate, x, z):
            continue
        gates.add(place)
        wires |= {*gate.wires, *x, *z}
    return Trace(frozenset(wires), frozenset(gates))


@lru_cache(maxsize=64)
def gates_of(circuit: Circuit) -> tuple[tuple[int, Gate | Amplitudes], ...]:
    """All gates in order, each with the place of its operation in the circuit."""
    return tuple(
        (place, gate)
        for place, operation in enumerate(circuit.operations)
        for gate in ([operation] if isinstance(operation, Amplitudes) else as_gates(operation, circuit))
    )


def _carry_back(gate: Gate, x: set[int], z: set[int]) -> bool:
    """Changes x and z, the wires where the observable may act as X or Y and as Z or Y, to those before the gate.

    False if the gate does nothing to the observable.
    """
    clifford = clifford_frame(gate)
    if clifford is not None:
        bits = {wire: 1 << place for place, wire in enumerate(reversed(gate.wires))}
        before = [Word(bit, 0, 0) for wire, bit in bits.items() if wire in x]
        before += [Word(0, bit, 0) for wire, bit in bits.items() if wire in z]
        after = [clifford(word) for word in before]
        if after == before:
            return False
        for wire, bit in bits.items():
            for letters, present in ((x, any(word.x & bit for word in after)), (z, any(w.z & bit for w in after))):
                (letters.add if present else letters.discard)(wire)
        return True
    changed = False
    for rotation in reversed(gate.rotations):
        word = list(zip(gate.wires, rotation.letters, strict=True))
        if any((wire in x and letter in "ZY") or (wire in z and letter in "XY") for wire, letter in word):
            x.update(wire for wire, letter in word if letter in "XY")
            z.update(wire for wire, letter in word if letter in "ZY")
            changed = True
    return changed


def _base_frequency(circuit: Circuit, wire: int) -> float:
    """The largest frequency that all encoding scales of a wire are multiples of; 0 if the wire has no encoding."""
    scales = [abs(op.scales[wire]) for op in circuit.operations if isinstance(op, Encoding) and op.scales[wire]]
    if not scales:
        return 0.0
    ratios = [Fraction(scale / scales[0]).limit_denominator(64) for scale in scales]
    if any(abs(float(ratio) * scales[0] - scale) > 1e-12 * scale for ratio, scale in zip(ratios, scales, strict=True)):
        raise TooLarge(
            f"lightcone: the encoding scales {scales} of wire {wire} have no common unit;"
            " choose method=statevector or auto"
        )
    denominator = lcm(*(ratio.denominator for ratio in ratios))
    numerator = gcd(*(int(ratio * denominator) for ratio in ratios))
    return scales[0] * numerator / denominator
