"""Light cones: which encodings an output depends on, found by pulling its observable back through the circuit.

Each output is a trigonometric polynomial of the inputs in its cone (arXiv:2008.08605): an encoding with scale s adds
{-s, 0, s} to the frequencies of its wire. Only two bits a wire are tracked (may the observable act there as X or Y?
as Z or Y?), so a cone may come out too large, never too small.
"""

from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from math import gcd, lcm

from qnerf.quantum.circuit import Circuit, Encoding, Entangler

MAX_COEFFICIENTS = 1024  # of one output: beyond that a state vector is cheaper


@dataclass(frozen=True)
class Cone:
    """An output's inputs: frequencies of wire j are 0, 1, ..., degrees[j] times base_j (which is the same for all
    outputs)."""

    wires: tuple[int, ...]
    degrees: tuple[int, ...]

    @property
    def coefficients(self) -> int:
        total = 1
        for degree in self.degrees:
            total *= 2 * degree + 1
        return total


@dataclass(frozen=True)
class Cones:
    """One cone an output, and the unit of frequency of every wire."""

    cones: tuple[Cone, ...]
    bases: tuple[float, ...]


class TooLarge(ValueError):
    """The circuit has no light cones small enough to be worth a polynomial."""


@lru_cache(maxsize=256)
def find_cones(circuit: Circuit) -> Cones:
    """The cones of all outputs. TooLarge, in one line, where one needs more than MAX_COEFFICIENTS coefficients."""
    reached = [_reach(circuit, dict(word)) for word in circuit.observables]
    bases = tuple(_base(circuit, wire) for wire in range(circuit.wires))
    cones = []
    for output, scales in enumerate(reached):
        degrees = {}
        for wire, values in sorted(scales.items()):
            degree = round(sum(abs(value) for value in values) / bases[wire]) if bases[wire] else 0
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
    return Cones(tuple(cones), bases)


def _reach(circuit: Circuit, word: dict[int, str]) -> dict[int, list[float]]:
    """Scales of the encodings that an observable meets, by wire."""
    x = {wire for wire, letter in word.items() if letter in "XY"}
    z = {wire for wire, letter in word.items() if letter in "ZY"}
    found: dict[int, list[float]] = {}
    for operation in reversed(circuit.operations):
        if isinstance(operation, Entangler):
            for a, b in reversed(operation.pairs):
                if operation.gate == "CZ":  # X_a -> X_a Z_b and X_b -> Z_a X_b
                    added = ({b} if a in x else set()) | ({a} if b in x else set())
                    z |= added
                else:  # X_control -> X_control X_target and Z_target -> Z_control Z_target
                    x |= {b} if a in x else set()
                    z |= {a} if b in z else set()
        elif isinstance(operation, Encoding):
            for wire in x | z:
                acts = {"Z": wire in x, "X": wire in z, "Y": True}[operation.axis]
                if acts:
                    found.setdefault(wire, []).append(operation.scales[wire])
            if operation.axis == "Z":
                z |= x
            elif operation.axis == "X":
                x |= z
            else:
                x, z = x | z, x | z
        else:
            x, z = x | z, x | z
    return found


def _base(circuit: Circuit, wire: int) -> float:
    """The largest frequency of which all scales of a wire are multiples; 0 if there are none."""
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
