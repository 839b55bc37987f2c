"""Light cones: which inputs each output of a circuit depends on.

An output is a trigonometric polynomial of the inputs in its cone (arXiv:2008.08605): an encoding with scale s adds
{-s, 0, s} to the frequencies of its wire. The cone is found by carrying the observable back through the circuit
(Heisenberg picture). Two bits for each wire are tracked: may the observable act there as X or Y, and as Z or Y? A cone
may therefore come out too large, never too small. The wires that the observable never meets can be left out
(`registers`).

>>> from qnerf.quantum.circuit import ANSATZE
>>> cone = find_cones(ANSATZE.build("qiren", 8, 1)).cones[1]
>>> cone.wires, cone.coefficients
((0, 1, 2), 27)
"""

from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from math import gcd, lcm, prod
from typing import NamedTuple

from qnerf.quantum.circuit import Circuit, Encoding, Entangler, PauliWord, Rotations

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
    met = [trace(circuit, word).scales for word in circuit.words]
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


class Trace(NamedTuple):
    """What an observable meets on its way back to the start of a circuit.

    Attributes:
        wires: that it may act on at some time; no others have an effect on its expectation value.
        scales: wire -> scales of the encodings that do not commute with it.
    """

    wires: frozenset[int]
    scales: dict[int, list[float]]


def trace(circuit: Circuit, word: PauliWord) -> Trace:
    """The light cone of a Pauli word in a re-uploading circuit."""
    x = {wire for wire, letter in word if letter in "XY"}  # where the observable may act as X or Y
    z = {wire for wire, letter in word if letter in "ZY"}  # where it may act as Z or Y
    scales: dict[int, list[float]] = {}
    for operation in reversed(circuit.operations):
        if isinstance(operation, Rotations):
            x, z = x | z, x | z
        elif isinstance(operation, Entangler):
            for a, b in reversed(operation.pairs):
                if operation.gate == "CZ":  # X_a becomes X_a Z_b, X_b becomes Z_a X_b
                    z |= {wire for wire, other in ((b, a), (a, b)) if other in x}
                else:  # X_a becomes X_a X_b, Z_b becomes Z_a Z_b
                    x |= {b} if a in x else set()
                    z |= {a} if b in z else set()
        elif isinstance(operation, Encoding):
            turned = {"X": z, "Y": x | z, "Z": x}[operation.axis]
            met = [wire for wire in sorted(turned) if operation.scales[wire]]
            for wire in met:
                scales.setdefault(wire, []).append(operation.scales[wire])
            x, z = x | set(met if operation.axis != "Z" else ()), z | set(met if operation.axis != "X" else ())
    return Trace(frozenset(x | z), scales)


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
