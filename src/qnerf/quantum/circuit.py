"""What the circuit is: plain data, from which every engine and the PennyLane reference are derived.

A data re-uploading circuit starts in |0...0>, alternates trainable rotations, entanglers and encodings of the input,
and ends with the expectation values of Pauli words. `ANSATZE` names the known descriptions; a new one is a function
that returns a `Circuit`:

>>> @ANSATZE.register("mine")
... def mine(wires: int, spectral: int) -> Circuit:
...     return reuploading("mine", wires, spectral, entangler="CNOT", ranges=(1, 1))
"""

from dataclasses import dataclass
from math import isfinite

from qnerf.config.registry import Registry

MAX_WIRES = 14
GATES = ("CZ", "CNOT")
LETTERS = ("X", "Y", "Z")

Word = tuple[tuple[int, str], ...]
"""A Pauli word: (wire, letter) pairs; wires that are left out carry the identity."""


@dataclass(frozen=True)
class Rotations:
    """Rot(phi, theta, omega) = RZ(omega) RY(theta) RZ(phi) on every wire, angles from row `row` of the stacked
    weights."""

    row: int


@dataclass(frozen=True)
class Entangler:
    """`gate` on each pair of wires (control, target), in this order."""

    gate: str
    pairs: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Encoding:
    """Rotation about `axis` on every wire j by the angle `scales[j]` x_j (radians)."""

    axis: str
    scales: tuple[float, ...]


Operation = Rotations | Entangler | Encoding


@dataclass(frozen=True)
class Circuit:
    """A circuit on `wires` wires with `spectral` encodings and S + 1 trainable blocks of `sublayers` sublayers each.

    Angles come from `weights1` (S, sublayers, n, 3) and `weights2` (sublayers, n, 3), stacked in this order:
    row r = block * sublayers + sublayer. The k-th output is the expectation value of `observables[k]`, in [-1, 1].
    """

    name: str
    wires: int
    spectral: int
    sublayers: int
    operations: tuple[Operation, ...]
    observables: tuple[Word, ...]

    def __post_init__(self) -> None:
        check_wires(self.wires)
        if self.spectral < 1:
            raise ValueError(f"ansatz {self.name}: spectral layers must be at least 1, got {self.spectral}")
        if self.sublayers < 1:
            raise ValueError(f"ansatz {self.name}: sublayers must be at least 1, got {self.sublayers}")
        for operation in self.operations:
            self._check(operation)
        letters: dict[int, str] = {}
        for word in self.observables:
            for wire, letter in word:
                if not 0 <= wire < self.wires or letter not in LETTERS:
                    known = ", ".join(LETTERS)
                    raise ValueError(
                        f"ansatz {self.name}: observable {word} needs wires below {self.wires}, letters {known}"
                    )
                if letters.setdefault(wire, letter) != letter:
                    both = f"{letters[wire]} and {letter}"
                    raise ValueError(
                        f"ansatz {self.name}: wire {wire} is measured in {both}; give each wire one letter"
                    )

    def _check(self, operation: Operation) -> None:
        n, rows = self.wires, self.rows
        if isinstance(operation, Rotations) and not 0 <= operation.row < rows:
            raise ValueError(f"ansatz {self.name}: rotations use row {operation.row}, weights have rows 0..{rows - 1}")
        if isinstance(operation, Entangler):
            if operation.gate not in GATES:
                raise ValueError(f"ansatz {self.name}: unknown gate {operation.gate!r}; known: {', '.join(GATES)}")
            for pair in operation.pairs:
                if len(pair) != 2 or pair[0] == pair[1] or not all(0 <= wire < n for wire in pair):
                    raise ValueError(f"ansatz {self.name}: pair {pair} needs two different wires below {n}")
        if isinstance(operation, Encoding):
            if operation.axis not in LETTERS:
                raise ValueError(f"ansatz {self.name}: unknown axis {operation.axis!r}; known: {', '.join(LETTERS)}")
            if len(operation.scales) != n or not all(isfinite(scale) for scale in operation.scales):
                raise ValueError(f"ansatz {self.name}: encoding needs {n} finite scales, got {operation.scales}")

    @property
    def rows(self) -> int:
        """Rows of the stacked weights."""
        return (self.spectral + 1) * self.sublayers

    @property
    def shapes(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Shapes of `weights1` and `weights2`."""
        return (self.spectral, self.sublayers, self.wires, 3), (self.sublayers, self.wires, 3)


def check_wires(wires: int) -> None:
    """ValueError unless 1 <= wires <= 14; it says what one state vector would take."""
    if isinstance(wires, bool) or not isinstance(wires, int) or not 1 <= wires <= MAX_WIRES:
        size = ""
        if isinstance(wires, int) and wires > MAX_WIRES:
            size = f" (one state of {wires} wires takes {readable_bytes(16 * 2.0**wires)} of memory in float64)"
        raise ValueError(f"wires must be an integer in 1..{MAX_WIRES}, got {wires!r}{size}")


def readable_bytes(count: float) -> str:
    for unit in ("B", "KiB", "MiB", "GiB", "TiB", "PiB"):
        if count < 1024 or unit == "PiB":
            return f"{count:.3g} {unit}"
        count /= 1024
    raise AssertionError


def ring(wires: int, distance: int) -> tuple[tuple[int, int], ...]:
    """Pairs (i, (i + distance) mod n) for every wire i; none for a single wire."""
    if wires == 1:
        return ()
    return tuple((i, (i + distance) % wires) for i in range(wires))


def reuploading(
    name: str,
    wires: int,
    spectral: int,
    *,
    sublayers: int = 2,
    entangler: str = "CZ",
    ranges: tuple[int, ...] | None = None,
    axis: str = "Z",
    scaling: str = "unit",
    scale: float = 1.0,
    observable: str = "Z",
) -> Circuit:
    """The family around QIREN: S times (trainable block, encoding), one closing block, one Pauli letter on every wire.

    ranges   distance of the entangling ring in each sublayer; None: 1 + (l mod (n - 1)), PennyLane's
             StronglyEntanglingLayers
    scaling  unit: every encoding has the same scale; ternary: the s-th encoding is scaled by 3^s, which makes the
             3^S frequencies of a wire all different (Shin et al., arXiv:2206.12105)
    scale    factor on every encoding angle
    """
    check_wires(wires)
    if scaling not in ("unit", "ternary"):
        raise ValueError(f"ansatz {name}: unknown scaling {scaling!r}; known: ternary, unit")
    if observable not in LETTERS:
        raise ValueError(f"ansatz {name}: unknown observable {observable!r}; known: {', '.join(LETTERS)}")
    distances = ranges or tuple(1 + (layer % (wires - 1)) if wires > 1 else 0 for layer in range(sublayers))
    if len(distances) != sublayers or (wires > 1 and any(distance % wires == 0 for distance in distances)):
        raise ValueError(
            f"ansatz {name}: ranges needs {sublayers} distances, none a multiple of {wires}, got {distances}"
        )
    operations: list[Operation] = []
    for block in range(spectral + 1):
        for layer in range(sublayers):
            operations.append(Rotations(block * sublayers + layer))
            operations.append(Entangler(entangler, ring(wires, distances[layer])))
        if block < spectral:
            factor = scale * (3.0**block if scaling == "ternary" else 1.0)
            operations.append(Encoding(axis, (factor,) * wires))
    observables = tuple(((wire, observable),) for wire in range(wires))
    return Circuit(name, wires, spectral, sublayers, tuple(operations), observables)


ANSATZE: Registry[Circuit] = Registry("ansatz")


@ANSATZE.register("qiren")
def qiren(
    wires: int,
    spectral: int,
    *,
    sublayers: int = 2,
    entangler: str = "CZ",
    ranges: tuple[int, ...] | None = None,
    axis: str = "Z",
    scaling: str = "unit",
    scale: float = 1.0,
    observable: str = "Z",
) -> Circuit:
    """QIREN (Zhao et al., arXiv:2406.03873): RZ encodings between StronglyEntanglingLayers with CZ, <Z> on every
    wire."""
    return reuploading(
        "qiren",
        wires,
        spectral,
        sublayers=sublayers,
        entangler=entangler,
        ranges=ranges,
        axis=axis,
        scaling=scaling,
        scale=scale,
        observable=observable,
    )


@ANSATZE.register("cnot")
def cnot(wires: int, spectral: int) -> Circuit:
    """QIREN with CNOT, the default imprimitive of StronglyEntanglingLayers."""
    return reuploading("cnot", wires, spectral, entangler="CNOT")


@ANSATZE.register("neighbours")
def neighbours(wires: int, spectral: int) -> Circuit:
    """QIREN with both rings at distance 1: narrower light cones."""
    return reuploading("neighbours", wires, spectral, ranges=(1, 1))


@ANSATZE.register("ternary")
def ternary(wires: int, spectral: int) -> Circuit:
    """QIREN with the s-th encoding scaled by 3^s: exponentially many frequencies."""
    return reuploading("ternary", wires, spectral, scaling="ternary")


@ANSATZE.register("rx")
def rx(wires: int, spectral: int) -> Circuit:
    """QIREN with RX encodings."""
    return reuploading("rx", wires, spectral, axis="X")


@ANSATZE.register("ry")
def ry(wires: int, spectral: int) -> Circuit:
    """QIREN with RY encodings."""
    return reuploading("ry", wires, spectral, axis="Y")


@ANSATZE.register("pauli_x")
def pauli_x(wires: int, spectral: int) -> Circuit:
    """QIREN read out in X instead of Z: the last ring no longer drops out."""
    return reuploading("pauli_x", wires, spectral, observable="X")
