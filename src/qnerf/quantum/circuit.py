"""A circuit as plain data: the list of its gates and what is measured at the end.

Every engine, the drawing and the PennyLane circuit are derived from this description. The circuits here are data
re-uploading circuits: they start in |0...0>, alternate trainable rotations, entanglers and encodings of the input, and
end with expectation values of Pauli words.

`ANSATZE` holds the circuits that have a name. A new one is a function of the wires and the spectral layers that
returns a `Circuit`; its keyword-only parameters are options that a configuration can set:

    @ANSATZE.register("mine")
    def mine(wires: int, spectral: int, *, axis: str = "Y") -> Circuit:
        return reuploading("mine", wires, spectral, entangler="CNOT", ranges=(1, 1), axis=axis)

A circuit that is not of the re-uploading family lists its operations itself:

>>> bell = Circuit(
...     "bell", wires=2, spectral=1, sublayers=1,
...     operations=(Rotations(0), Entangler("CNOT", ((0, 1),)), Encoding("Z", (1.0, 2.0)), Rotations(1)),
...     observables=(((0, "Z"), (1, "Z")),),
... )
>>> bell.weight_shapes
((1, 1, 2, 3), (1, 2, 3))
"""

from dataclasses import dataclass, replace
from math import isfinite
from typing import Annotated, Any, Literal, get_args

from annotated_types import Interval

from qnerf.config.bounds import Factor
from qnerf.config.registry import Registry

MAX_WIRES = 20
MAX_SPECTRAL = 64  # the largest scale of ternary encodings, 3^63, is still a float32

Wires = Annotated[int, Interval(ge=1, le=MAX_WIRES)]
Spectral = Annotated[int, Interval(ge=1, le=MAX_SPECTRAL)]
EntanglingGate = Literal["CZ", "CNOT"]
Pauli = Literal["X", "Y", "Z"]
ENTANGLING_GATES = get_args(EntanglingGate)
PAULIS = get_args(Pauli)

PauliWord = tuple[tuple[int, str], ...]
"""A product of Pauli operators as (wire, letter) pairs. Wires that are left out carry the identity."""


@dataclass(frozen=True)
class Rotations:
    """Rot(phi, theta, omega) = RZ(omega) RY(theta) RZ(phi) on every wire.

    The angles, in radians, are row `row` of the stacked weights (see `Circuit`).
    """

    row: int


@dataclass(frozen=True)
class Entangler:
    """`gate` (CZ or CNOT) on each pair of wires (control, target), in this order."""

    gate: str
    pairs: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Encoding:
    """A rotation about `axis` (X, Y or Z) on every wire j, by the angle `scales[j]` x_j in radians."""

    axis: str
    scales: tuple[float, ...]


Operation = Rotations | Entangler | Encoding


@dataclass(frozen=True)
class Circuit:
    """A circuit on n = `wires` wires with S = `spectral` encodings.

    The S + 1 trainable blocks have L = `sublayers` sublayers each. Their angles are `weights1` (S, L, n, 3) and
    `weights2` (L, n, 3), stacked in this order: row r = block * L + sublayer. Output k is the expectation value of
    `observables[k]`, in [-1, 1]. Wire 0 is the most significant bit of a basis state, as in PennyLane.

    Raises:
        ValueError: an operation, row, wire, gate, axis or Pauli letter that does not exist, no observable, or one wire
            measured in two letters. All outputs can therefore be read in the same shot.
    """

    name: str
    wires: int
    spectral: int
    sublayers: int
    operations: tuple[Operation, ...]
    observables: tuple[PauliWord, ...]

    def __post_init__(self) -> None:
        check_wires(self.wires)
        for name, value in (("spectral layers", self.spectral), ("sublayers", self.sublayers)):
            if value < 1:
                raise self._error(f"{name} must be at least 1, got {value}")
        for operation in self.operations:
            self._check(operation)
        measured: dict[int, str] = {}
        if not self.observables:
            raise self._error("needs at least one observable")
        for word in self.observables:
            if len({wire for wire, _ in word}) < len(word):
                raise self._error(f"observable {word} has more than one letter on a wire")
            for wire, letter in word:
                if not 0 <= wire < self.wires or letter not in PAULIS:
                    known = ", ".join(PAULIS)
                    raise self._error(f"observable {word} needs wires below {self.wires}, letters {known}")
                if measured.setdefault(wire, letter) != letter:
                    both = f"{measured[wire]} and {letter}"
                    raise self._error(f"wire {wire} is measured in {both}; give each wire one letter")

    def _error(self, message: str) -> ValueError:
        return ValueError(f"ansatz {self.name}: {message}")

    def _check(self, operation: Operation) -> None:
        n, rows = self.wires, self.rows
        if not isinstance(operation, Operation):
            known = ", ".join(kind.__name__ for kind in get_args(Operation))
            raise self._error(f"unknown operation {operation!r}; known: {known}")
        if isinstance(operation, Rotations) and not 0 <= operation.row < rows:
            raise self._error(f"rotations use row {operation.row}, weights have rows 0..{rows - 1}")
        if isinstance(operation, Entangler):
            if operation.gate not in ENTANGLING_GATES:
                raise self._error(f"unknown gate {operation.gate!r}; known: {', '.join(ENTANGLING_GATES)}")
            for pair in operation.pairs:
                if len(pair) != 2 or pair[0] == pair[1] or not all(0 <= wire < n for wire in pair):
                    raise self._error(f"pair {pair} needs two different wires below {n}")
        if isinstance(operation, Encoding):
            if operation.axis not in PAULIS:
                raise self._error(f"unknown axis {operation.axis!r}; known: {', '.join(PAULIS)}")
            if len(operation.scales) != n or not all(isfinite(scale) for scale in operation.scales):
                raise self._error(f"encoding needs {n} finite scales, got {operation.scales}")

    @property
    def rows(self) -> int:
        """Rows of the stacked weights, (S + 1) L."""
        return (self.spectral + 1) * self.sublayers

    @property
    def weight_shapes(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Shapes of `weights1` and `weights2`."""
        return (self.spectral, self.sublayers, self.wires, 3), (self.sublayers, self.wires, 3)


def check_wires(wires: int) -> None:
    """ValueError unless 1 <= wires <= 20. The message says how much memory one state vector would take."""
    if isinstance(wires, bool) or not isinstance(wires, int) or not 1 <= wires <= MAX_WIRES:
        size = ""
        if isinstance(wires, int) and wires > MAX_WIRES:
            size = f" (one state of {wires} wires takes {readable_bytes(16 * 2.0**wires)} of memory in float64)"
        raise ValueError(f"wires must be an integer in 1..{MAX_WIRES}, got {wires!r}{size}")


def readable_bytes(count: float) -> str:
    """
    >>> readable_bytes(3 * 2**20)
    '3 MiB'
    """
    for unit in ("B", "KiB", "MiB", "GiB", "TiB"):
        if count < 1024:
            return f"{count:.3g} {unit}"
        count /= 1024
    return f"{count:.3g} PiB"


def ring(wires: int, distance: int) -> tuple[tuple[int, int], ...]:
    """Pairs (i, (i + distance) mod n) for every wire i; none for a single wire.

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
        wires: n, 1 to 20.
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
    """QIREN measured in X instead of Z. The last ring then has an effect; before a Z measurement it has none.

    0: ──Rot─╭●────╭Z──Rot─╭●─╭Z──RZ──Rot──────╭●────╭Z──Rot─╭●─╭Z────┤  <X>
    1: ──Rot─╰Z─╭●─│───Rot─│──╰●─╭Z───RZ───Rot─╰Z─╭●─│───Rot─│──╰●─╭Z─┤  <X>
    2: ──Rot────╰Z─╰●──Rot─╰Z────╰●───RZ───Rot────╰Z─╰●──Rot─╰Z────╰●─┤  <X>
    """
    return reuploading("pauli_x", wires, spectral, observable="X")
