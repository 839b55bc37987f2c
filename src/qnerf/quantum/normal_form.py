"""The circuit in normal form: what is left to compute once everything that commutes or cancels has been merged.

Every gate of a description is a product of rotations about Z (diagonal: a phase on each amplitude), rotations about Y
(real) and permutations of the basis. In the normal form neighbouring diagonals are one `Phase`, neighbouring Y
rotations one `Turn`:
RZ angles before and after an encoding simply add to its angle, CZ rings are signs of the same diagonal, phases on
|0...0> and phases just before a Z measurement are gone. X and Y are measured as Z after a fixed rotation.
"""

from collections import Counter
from dataclasses import dataclass, field, replace
from functools import lru_cache
from math import pi

import numpy as np

from qnerf.quantum.circuit import Circuit, Encoding, Entangler, Rotations

PHI, THETA, OMEGA = 0, 1, 2


@dataclass(frozen=True)
class Angles:
    """One angle per wire: constant_j + the sum of `entries` of the weights + scale_j x_j (radians).

    An entry (row, k) is the k-th angle of Rot(phi, theta, omega) in that row of the stacked weights, on every wire.
    """

    entries: tuple[tuple[int, int], ...] = ()
    constant: tuple[float, ...] | None = None
    scales: tuple[float, ...] | None = None

    def __add__(self, other: "Angles") -> "Angles":
        return Angles(
            self.entries + other.entries, _added(self.constant, other.constant), _added(self.scales, other.scales)
        )


@dataclass(frozen=True)
class Phase:
    """exp(-i/2 sum_j angle_j z_j) prod_{(a, b) in pairs} CZ(a, b), with z_j = +1 for bit 0 and -1 for bit 1."""

    angles: Angles = field(default_factory=Angles)
    pairs: tuple[tuple[int, int], ...] = ()

    @property
    def empty(self) -> bool:
        return self.angles == Angles() and not self.pairs


@dataclass(frozen=True)
class Turn:
    """RY(angle_j) on every wire."""

    angles: Angles


@dataclass(frozen=True)
class Permute:
    """CNOT(control, target), in this order."""

    pairs: tuple[tuple[int, int], ...]


Step = Phase | Turn | Permute


@dataclass(frozen=True)
class Program:
    """`steps` on |0...0>, then the expectation values of products of Z on the wires of each word."""

    circuit: Circuit
    steps: tuple[Step, ...]
    words: tuple[frozenset[int], ...]

    @property
    def wires(self) -> int:
        return self.circuit.wires

    @property
    def fixed_steps(self) -> int:
        """Number of leading steps that do not depend on the input: done once, not per sample."""
        for index, step in enumerate(self.steps):
            if not isinstance(step, Permute) and step.angles.scales is not None:
                return index
        return len(self.steps)

    @property
    def local(self) -> bool:
        """Whether every word is Z on one wire and the last step a Turn that can be moved into the measurement."""
        last = self.steps[-1] if self.steps else None
        return (
            isinstance(last, Turn)
            and all(len(word) == 1 for word in self.words)
            and last.angles.scales is None
            and self.fixed_steps < len(self.steps) - 1
        )


@lru_cache(maxsize=256)
def compile_program(circuit: Circuit) -> Program:
    """The normal form of `circuit`."""
    steps: list[Step] = []
    for operation in circuit.operations:
        if isinstance(operation, Rotations):
            row = operation.row
            _append(steps, Phase(Angles(((row, PHI),))))
            _append(steps, Turn(Angles(((row, THETA),))))
            _append(steps, Phase(Angles(((row, OMEGA),))))
        elif isinstance(operation, Entangler):
            _append(steps, Phase(pairs=operation.pairs) if operation.gate == "CZ" else Permute(operation.pairs))
        else:
            _encode(steps, operation, circuit.wires)
    letters = {wire: letter for word in circuit.observables for wire, letter in word}
    quarter = tuple({"X": -pi / 2, "Y": pi / 2}.get(letters.get(wire, "Z"), 0.0) for wire in range(circuit.wires))
    if any(quarter):
        # X = Z after RY(-pi/2); Y = Z after RX(pi/2) = RZ(-pi/2) RY(pi/2) RZ(pi/2), whose last factor does not matter.
        before = tuple(pi / 2 if letters.get(wire) == "Y" else 0.0 for wire in range(circuit.wires))
        _append(steps, Phase(Angles(constant=before if any(before) else None)))
        _append(steps, Turn(Angles(constant=quarter)))
    words = tuple(frozenset(wire for wire, _ in word) for word in circuit.observables)
    while steps and not isinstance(steps[-1], Turn):
        last = steps.pop()
        if isinstance(last, Permute):
            words = tuple(_through(last, word) for word in words)
    while steps and not isinstance(steps[0], Turn):
        steps.pop(0)  # |0...0> is an eigenstate of phases and of CNOTs
    return Program(circuit, tuple(steps), words)


def _append(steps: list[Step], step: Step) -> None:
    if isinstance(step, Phase):
        odd = tuple(sorted(p for p, c in Counter((min(p), max(p)) for p in step.pairs).items() if c % 2))
        step = replace(step, pairs=odd)  # CZ is symmetric and its own inverse
        if step.empty:
            return
    elif isinstance(step, Permute):
        if not step.pairs:
            return
    elif step.angles == Angles():
        return
    last = steps[-1] if steps else None
    if isinstance(step, Phase) and isinstance(last, Phase):
        steps.pop()
        _append(steps, Phase(last.angles + step.angles, last.pairs + step.pairs))
    elif isinstance(step, Turn) and isinstance(last, Turn):
        steps[-1] = Turn(last.angles + step.angles)
    elif isinstance(step, Permute) and isinstance(last, Permute):
        steps[-1] = Permute(last.pairs + step.pairs)
    else:
        steps.append(step)


def _encode(steps: list[Step], encoding: Encoding, wires: int) -> None:
    angles = Angles(scales=encoding.scales)
    if encoding.axis == "Z":
        _append(steps, Phase(angles))
    elif encoding.axis == "Y":
        _append(steps, Turn(angles))
    else:  # RX(a) = RZ(-pi/2) RY(a) RZ(pi/2)
        _append(steps, Phase(Angles(constant=(pi / 2,) * wires)))
        _append(steps, Turn(angles))
        _append(steps, Phase(Angles(constant=(-pi / 2,) * wires)))


def _through(permute: Permute, word: frozenset[int]) -> frozenset[int]:
    """The Z word before the CNOTs that equals `word` after them: Z_target -> Z_control Z_target."""
    for control, target in reversed(permute.pairs):
        if target in word:
            word = word ^ {control}
    return word


def _added(a: tuple[float, ...] | None, b: tuple[float, ...] | None) -> tuple[float, ...] | None:
    if a is None or b is None:
        return a if b is None else b
    return tuple(x + y for x, y in zip(a, b, strict=True))


def bits(wires: int) -> np.ndarray:
    """(2^n, n) bit of each wire in each basis state; wire 0 is the most significant, as in PennyLane."""
    return (np.arange(2**wires)[:, None] >> np.arange(wires - 1, -1, -1)[None, :]) & 1


def signs(pairs: tuple[tuple[int, int], ...], wires: int) -> np.ndarray:
    """(2^n,) +1 or -1: the diagonal of a product of CZ."""
    table = bits(wires)
    odd = np.zeros(2**wires, dtype=np.int64)
    for a, b in pairs:
        odd += table[:, a] * table[:, b]
    return 1.0 - 2.0 * (odd % 2)


def parities(words: tuple[frozenset[int], ...], wires: int) -> np.ndarray:
    """(words, 2^n) eigenvalues +1 or -1 of each product of Z."""
    table = bits(wires)
    return np.stack([1.0 - 2.0 * (table[:, sorted(word)].sum(1) % 2) for word in words])


def sources(permute: Permute, wires: int) -> np.ndarray:
    """(2^n,) `after = before[sources]`."""
    index = np.arange(2**wires)
    for control, target in reversed(permute.pairs):
        index = index ^ (((index >> (wires - 1 - control)) & 1) << (wires - 1 - target))
    return index
