"""The normal form of a circuit: the few steps that are left once gates that commute or cancel are merged.

Every gate is a product of rotations about Z (a diagonal: one phase for each amplitude), rotations about Y (real) and
permutations of the basis states (CNOTs). In the normal form neighbouring diagonals are one `Diagonal` and neighbouring
Y rotations one `RYLayer`. RZ angles before and after an RZ encoding add to the encoding's angle, and CZ rings are signs
of the same diagonal. Encodings about X and Y are RZ encodings between fixed rotations. Phases on |0...0> and before a Z
measurement have no effect and are dropped. X and Y are measured as Z after a fixed rotation.

>>> from qnerf.quantum.circuit import ANSATZE
>>> form = normal_form(ANSATZE.build("qiren", 4, 1))
>>> [type(step).__name__ for step in form.steps]
['RYLayer', 'Diagonal', 'RYLayer', 'Diagonal', 'RYLayer', 'Diagonal', 'RYLayer']
>>> form.fixed_steps  # the encoding is in the second diagonal
3
"""

from collections import Counter
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from math import pi

import numpy as np

from qnerf.quantum.circuit import Circuit, Encoding, Entangler, Rotations

PHI, THETA, OMEGA = 0, 1, 2


@dataclass(frozen=True)
class Angles:
    """One angle for each wire j, in radians: constant_j + the sum of `weights` + scale_j x_j.

    A weight (row, k) is the k-th angle of Rot(phi, theta, omega) in that row of the weights, on every wire.
    """

    weights: tuple[tuple[int, int], ...] = ()
    constant: tuple[float, ...] | None = None
    scales: tuple[float, ...] | None = None

    def __add__(self, other: "Angles") -> "Angles":
        return Angles(
            self.weights + other.weights, _add(self.constant, other.constant), _add(self.scales, other.scales)
        )


@dataclass(frozen=True)
class Diagonal:
    """exp(-i/2 sum_j angle_j z_j) prod_{(a, b) in pairs} CZ(a, b), with z_j = +1 for bit 0 and -1 for bit 1."""

    angles: Angles = field(default_factory=Angles)
    pairs: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True)
class RYLayer:
    """RY(angle_j) on every wire j. No angle depends on the input."""

    angles: Angles


@dataclass(frozen=True)
class CNOTs:
    """CNOT(control, target) for each pair, in this order."""

    pairs: tuple[tuple[int, int], ...]


Step = Diagonal | RYLayer | CNOTs


@dataclass(frozen=True)
class NormalForm:
    """`steps` on |0...0>; then output k is the expectation value of the product of Z on the wires `measured[k]`."""

    circuit: Circuit
    steps: tuple[Step, ...]
    measured: tuple[frozenset[int], ...]

    @property
    def wires(self) -> int:
        return self.circuit.wires

    @cached_property
    def fixed_steps(self) -> int:
        """Number of leading steps that do not depend on the input. They run once for a whole batch."""
        for index, step in enumerate(self.steps):
            if isinstance(step, Diagonal) and step.angles.scales is not None:
                return index
        return len(self.steps)

    @cached_property
    def measures_last_layer(self) -> bool:
        """Whether the last RY layer can be part of the measurement.

        <Z> after RY(a) is cos(a) <Z> - sin(a) <X> before it. This needs outputs of one wire each, and a last layer
        that comes after the first encoding.
        """
        last = self.steps[-1] if self.steps else None
        return (
            isinstance(last, RYLayer)
            and all(len(wires) == 1 for wires in self.measured)
            and self.fixed_steps < len(self.steps) - 1
        )


@lru_cache(maxsize=256)
def normal_form(circuit: Circuit) -> NormalForm:
    """The normal form of `circuit`.

    Raises:
        ValueError: the circuit does not re-upload data; `pauli_form` takes any circuit.
    """
    if not circuit.reuploading:
        raise ValueError(f"ansatz {circuit.name}: not a data re-uploading circuit (Rotations, Entangler, Encoding)")
    steps: list[Step] = []
    for operation in circuit.operations:
        if isinstance(operation, Rotations):
            row = operation.row
            _append(steps, Diagonal(Angles(((row, PHI),))))
            _append(steps, RYLayer(Angles(((row, THETA),))))
            _append(steps, Diagonal(Angles(((row, OMEGA),))))
        elif isinstance(operation, Entangler):
            _append(steps, Diagonal(pairs=operation.pairs) if operation.gate == "CZ" else CNOTs(operation.pairs))
        elif isinstance(operation, Encoding):
            _append_encoding(steps, operation, circuit.wires)
    letters = {wire: letter for word in circuit.words for wire, letter in word}
    quarter = tuple({"X": -pi / 2, "Y": pi / 2}.get(letters.get(wire, "Z"), 0.0) for wire in range(circuit.wires))
    if any(quarter):
        # X = Z after RY(-pi/2); Y = Z after RX(pi/2) = RZ(-pi/2) RY(pi/2) RZ(pi/2), whose last factor does not matter.
        before = tuple(pi / 2 if letters.get(wire) == "Y" else 0.0 for wire in range(circuit.wires))
        _append(steps, Diagonal(Angles(constant=before if any(before) else None)))
        _append(steps, RYLayer(Angles(constant=quarter)))
    measured = tuple(frozenset(wire for wire, _ in word) for word in circuit.words)
    while steps and not isinstance(steps[-1], RYLayer):
        last = steps.pop()
        if isinstance(last, CNOTs):
            measured = tuple(_before_cnots(last, wires) for wires in measured)
    while steps and not isinstance(steps[0], RYLayer):
        steps.pop(0)  # |0...0> is an eigenstate of diagonals and of CNOTs
    return NormalForm(circuit, tuple(steps), measured)


def _append(steps: list[Step], step: Step) -> None:
    """Adds a step, merged with the last one where both are of one kind; a step without effect is left out."""
    if isinstance(step, Diagonal):
        odd = tuple(sorted(p for p, c in Counter((min(p), max(p)) for p in step.pairs).items() if c % 2))
        step = replace(step, pairs=odd)  # CZ is symmetric and its own inverse
    if step in (Diagonal(), RYLayer(Angles()), CNOTs(())):
        return
    last = steps[-1] if steps else None
    if isinstance(step, Diagonal) and isinstance(last, Diagonal):
        steps.pop()
        _append(steps, Diagonal(last.angles + step.angles, last.pairs + step.pairs))
    elif isinstance(step, RYLayer) and isinstance(last, RYLayer):
        steps[-1] = RYLayer(last.angles + step.angles)
    elif isinstance(step, CNOTs) and isinstance(last, CNOTs):
        steps[-1] = CNOTs(last.pairs + step.pairs)
    else:
        steps.append(step)


def _append_encoding(steps: list[Step], encoding: Encoding, wires: int) -> None:
    """RX(a) = RY(pi/2) RZ(a) RY(-pi/2), and RY(a) = RZ(pi/2) RX(a) RZ(-pi/2)."""

    def quarter(sign: int) -> Angles:
        return Angles(constant=(sign * pi / 2,) * wires)

    if encoding.axis == "Y":
        _append(steps, Diagonal(quarter(-1)))
    if encoding.axis != "Z":
        _append(steps, RYLayer(quarter(-1)))
    _append(steps, Diagonal(Angles(scales=encoding.scales)))
    if encoding.axis != "Z":
        _append(steps, RYLayer(quarter(1)))
    if encoding.axis == "Y":
        _append(steps, Diagonal(quarter(1)))


def _before_cnots(cnots: CNOTs, wires: frozenset[int]) -> frozenset[int]:
    """The product of Z before the CNOTs that equals the given one after them: Z_target -> Z_control Z_target."""
    for control, target in reversed(cnots.pairs):
        if target in wires:
            wires = wires ^ {control}
    return wires


def _add(a: tuple[float, ...] | None, b: tuple[float, ...] | None) -> tuple[float, ...] | None:
    if a is None or b is None:
        return a if b is None else b
    return tuple(x + y for x, y in zip(a, b, strict=True))


def basis_bits(wires: int) -> np.ndarray:
    """(2^n, n): the bit of each wire in each basis state. Wire 0 is the most significant, as in PennyLane."""
    return (np.arange(2**wires)[:, None] >> np.arange(wires - 1, -1, -1)[None, :]) & 1


def cz_signs(pairs: tuple[tuple[int, int], ...], wires: int) -> np.ndarray:
    """(2^n,): the diagonal of a product of CZ, +1 or -1."""
    bits = basis_bits(wires)
    odd = np.zeros(2**wires, dtype=np.int64)
    for a, b in pairs:
        odd += bits[:, a] * bits[:, b]
    return 1.0 - 2.0 * (odd % 2)


def z_eigenvalues(measured: tuple[frozenset[int], ...], wires: int) -> np.ndarray:
    """(outputs, 2^n): the eigenvalue +1 or -1 of each product of Z in each basis state."""
    bits = basis_bits(wires)
    return np.stack([1.0 - 2.0 * (bits[:, sorted(product)].sum(1) % 2) for product in measured])


def cnot_permutation(pairs: tuple[tuple[int, int], ...], wires: int) -> np.ndarray:
    """(2^n,): the state after the CNOTs is `before[permutation]`."""
    index = np.arange(2**wires)
    for control, target in reversed(pairs):
        index = index ^ (((index >> (wires - 1 - control)) & 1) << (wires - 1 - target))
    return index
