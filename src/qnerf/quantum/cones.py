"""Light cones: which inputs each measured value of a circuit depends on.

A value is a trigonometric polynomial of the inputs in its cone (arXiv:2008.08605): a rotation by s x adds {-s, 0, s} to
the frequencies of x. The cone is found by carrying the observable back through the program (Heisenberg picture). Two
bits for each wire are tracked: may the observable act there as X or Y, and as Z or Y? A cone may therefore come out too
large, never too small. The wires that the observable never meets can be left out (`registers`).

>>> from qnerf.quantum.circuit import ANSATZE
>>> from qnerf.quantum.program import program
>>> cone = find_cones(program(ANSATZE.build("qiren", 8, 1))).cones[1]
>>> cone.features, cone.coefficients
((0, 1, 2), 27)
"""

from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from math import gcd, lcm, prod
from typing import NamedTuple

import numpy as np

from qnerf.quantum.circuit import Circuit
from qnerf.quantum.program import Block, Program, rotations_of, traced

MAX_COEFFICIENTS = 1024  # of one value: beyond that a state vector is cheaper


@dataclass(frozen=True)
class Cone:
    """The inputs of one value. The frequencies of feature i are 0, 1, ..., `degrees[i]` times its base frequency."""

    features: tuple[int, ...]
    degrees: tuple[int, ...]

    @property
    def coefficients(self) -> int:
        """Real coefficients of the polynomial, prod (2 degree + 1)."""
        return prod(2 * degree + 1 for degree in self.degrees)


@dataclass(frozen=True)
class Cones:
    """The cone of each value, and the base frequency of each feature (1 / radians; 0 if no angle has it)."""

    name: str
    cones: tuple[Cone, ...]
    base_frequencies: tuple[float, ...]


class TooLarge(ValueError):
    """The circuit has no light cones that are small enough for polynomials."""


@lru_cache(maxsize=256)
def find_cones(own: Program) -> Cones:
    """The cones of all measured values of a program.

    Raises:
        TooLarge: a value has more than `MAX_COEFFICIENTS` coefficients, the scales of a feature are not multiples of
            one frequency, or an angle or the start is another function of the input.
    """
    circuit = own.circuit
    if own.start_moves:
        raise TooLarge(f"lightcone: circuit {circuit.name} has a start that depends on the input; choose method=auto")
    everything = scales_of(own.blocks, circuit)
    if not everything:
        raise TooLarge(f"lightcone: circuit {circuit.name} depends on no input; choose method=auto")
    base = tuple(_base_frequency(feature, everything.get(feature, [])) for feature in range(circuit.features or 0))
    cones = []
    for value, (x, z) in enumerate(seeds(own)):
        met = scales_of(trace(own, x, z).blocks, circuit)
        degrees = {
            feature: round(sum(map(abs, scales)) / base[feature]) for feature, scales in sorted(met.items()) if scales
        }
        cone = Cone(tuple(degrees), tuple(degrees.values()))
        if cone.coefficients > MAX_COEFFICIENTS:
            raise TooLarge(
                f"lightcone: value {value} of circuit {circuit.name} with {circuit.wires} wires depends on"
                f" {len(cone.features)} inputs through {cone.coefficients} coefficients, more than {MAX_COEFFICIENTS};"
                " choose method=statevector or auto"
            )
        cones.append(cone)
    return Cones(circuit.name, tuple(cones), base)


def cones_of_outputs(own: Program) -> Cones:
    """The cones of all outputs, which are sums of values. Raises `TooLarge`, as `find_cones` does."""
    found, combination = find_cones(own), own.combination
    if combination is None:
        return found
    cones = []
    for row in combination:
        degrees: dict[int, int] = {}
        for value in row.nonzero()[0]:
            for feature, degree in zip(found.cones[value].features, found.cones[value].degrees, strict=True):
                degrees[feature] = max(degree, degrees.get(feature, 0))
        cones.append(Cone(tuple(sorted(degrees)), tuple(degrees[feature] for feature in sorted(degrees))))
        if cones[-1].coefficients > MAX_COEFFICIENTS:
            raise TooLarge(
                f"lightcone: an output of circuit {found.name} depends on too many inputs; choose method=auto"
            )
    return Cones(found.name, tuple(cones), found.base_frequencies)


def seeds(own: Program) -> list[tuple[int, int]]:
    """For each measured value the wires where it acts as X or Y, and those where it acts as Z or Y, as bits."""
    found = [(word.x, word.z) for word in own.words]
    for outcomes in own.tables:
        basis = np.arange(len(outcomes))
        mask = sum(1 << k for k in range(own.wires) if np.any(outcomes != outcomes[basis ^ (1 << k)]))
        found += [(0, mask)] * (int(outcomes.max()) + 1)
    return found


class Trace(NamedTuple):
    """What an observable meets on its way back to the start.

    Attributes:
        blocks: what of the program's blocks has an effect on it.
        wires: that it may act on at some time, as bits; no others have an effect on its expectation value.
    """

    blocks: list[Block]
    wires: int


def trace(own: Program, x: int, z: int) -> Trace:
    """The light cone of an observable that acts as X or Y on the wires x, as Z or Y on the wires z."""
    kept = []
    for block in reversed(own.blocks):
        met, x, z = traced(block, x, z)
        if met is not None:
            kept.append(met)
    return Trace(kept, x | z)


def scales_of(blocks: tuple[Block, ...] | list[Block], circuit: Circuit) -> dict[int, list[float]]:
    """Feature -> the factors that it has in the angles of the blocks.

    Raises:
        TooLarge: an angle that is no sum of numbers times features.
    """
    scales: dict[int, list[float]] = {}
    for block in blocks:
        for _, angle in rotations_of(block, circuit.wires):
            for factor, weights, features in angle.parts()[1].terms:
                if weights or len(features) > 1:
                    raise TooLarge(
                        f"lightcone: circuit {circuit.name} has the angle {angle}, whose frequencies are not fixed;"
                        " choose method=auto"
                    )
                scales.setdefault(features[0], []).append(factor)
    return scales


def _base_frequency(feature: int, scales: list[float]) -> float:
    """The largest frequency that all scales of a feature are multiples of; 0 if it has none."""
    if not scales:
        return 0.0
    ratios = [Fraction(abs(scale / scales[0])).limit_denominator(64) for scale in scales]
    if any(abs(float(r) * abs(scales[0]) - abs(s)) > 1e-12 * abs(s) for r, s in zip(ratios, scales, strict=True)):
        raise TooLarge(
            f"lightcone: the scales {scales} of feature {feature} have no common unit;"
            " choose method=statevector or auto"
        )
    denominator = lcm(*(ratio.denominator for ratio in ratios))
    numerator = gcd(*(int(ratio * denominator) for ratio in ratios))
    return abs(scales[0]) * numerator / denominator
