"""Circuits: a list of gates and what is measured at the end, as plain data; and circuits by name.

Every engine, the drawing and the PennyLane circuit are derived from this description. Any circuit is a list of gates,
each angle a number, a trainable weight, a feature of the input or a polynomial of them:

>>> from qnerf.quantum.expressions import feature
>>> w = Weights("w", (2,))
>>> mine = Circuit(
...     "mine", wires=2, features=3, weights=(w,),
...     operations=(Gate("H", (0,)), Gate("RY", (1,), (w[0] * feature(2),)), Gate("IsingXX", (0, 1), (w[1],))),
...     observables=(((0, "X"),), Hamiltonian((0.5, -1.0), (((0, "Z"), (1, "Z")), ((0, "X"),))), Probabilities((1,))),
... )
>>> mine.outputs, mine.parameters
(4, {'w': (2,)})

Data re-uploading circuits have operations of their own, on all wires at once, and engines that are faster still. They
start in |0...0>, alternate trainable rotations, entanglers and encodings of the input, and end with expectation values
of Pauli words.

Operations of both kinds go together:

>>> bell = Circuit(
...     "bell", wires=2, spectral=1, sublayers=1,
...     operations=(Rotations(0), Entangler("CNOT", ((0, 1),)), Encoding("Z", (1.0, 2.0)), Rotations(1)),
...     observables=(((0, "Z"), (1, "Z")),),
... )
>>> bell.weight_shapes
((1, 1, 2, 3), (1, 2, 3))

`ANSATZE` holds the circuits that have a name. A new one is a function of the wires and the spectral layers that returns
a `Circuit`; its keyword-only parameters are options that a configuration can set:

    @ANSATZE.register("mine")
    def mine(wires: int, spectral: int, *, axis: str = "Y") -> Circuit:
        return replace(qiren(wires, spectral, entangler="CNOT", axis=axis), name="mine")
"""

from dataclasses import dataclass, replace
from functools import cached_property
from math import isfinite, prod
from operator import index
from typing import Annotated, Any, Literal, get_args

from annotated_types import Interval

from qnerf.config.bounds import Factor
from qnerf.config.registry import Registry
from qnerf.quantum.expressions import Expression, Weights
from qnerf.quantum.expressions import feature as feature
from qnerf.quantum.expressions import weight as weight
from qnerf.quantum.gates import GATES as GATES
from qnerf.quantum.gates import Amplitudes, Gate, as_wires

MAX_STATE_WIRES = 20  # of a state
MAX_WIRES = 1024  # wires of a circuit
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

    The angles, in radians, are row `row` of the weights (see `Circuit`).
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


Operation = Rotations | Entangler | Encoding | Gate | Amplitudes


@dataclass(frozen=True)
class Hamiltonian:
    """A real combination of Pauli words: the output sum_k coefficients[k] <words[k]>. The word () is the identity."""

    coefficients: tuple[float, ...]
    words: tuple[PauliWord, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "coefficients", tuple(map(float, self.coefficients)))
        object.__setattr__(self, "words", tuple(map(_as_word, self.words)))
        if len(self.coefficients) != len(self.words) or not all(map(isfinite, self.coefficients)):
            raise ValueError(f"{self} needs one finite coefficient for each word")


@dataclass(frozen=True)
class Probabilities:
    """The probabilities of the 2^k bit strings of `wires`; the first wire is the most significant bit."""

    wires: tuple[int, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "wires", as_wires("probabilities", self.wires))


Observable = PauliWord | Hamiltonian | Probabilities


def _as_word(word: Any) -> PauliWord:
    """
    >>> _as_word([[0, "X"], [2, "Z"]])
    ((0, 'X'), (2, 'Z'))
    """
    try:
        return tuple((index(wire), str(letter)) for wire, letter in word)
    except (TypeError, ValueError):
        raise ValueError(
            f"observable {word!r} expects pairs of a wire and a letter, as in ((0, 'Z'), (1, 'Z')); "
            "or a Hamiltonian, or Probabilities"
        ) from None


def values_of(observable: Observable) -> int:
    """Number of outputs: 2^k for `Probabilities` of k wires, else 1."""
    return 2 ** len(observable.wires) if isinstance(observable, Probabilities) else 1


def as_sum(observable: PauliWord | Hamiltonian) -> Hamiltonian:
    """A Pauli word as a Hamiltonian of one word; a Hamiltonian as it is."""
    return observable if isinstance(observable, Hamiltonian) else Hamiltonian((1.0,), (observable,))


def _as_observable(observable: Any) -> "Observable":
    return observable if isinstance(observable, Hamiltonian | Probabilities) else _as_word(observable)


@dataclass(frozen=True)
class Circuit:
    """A circuit on n = `wires` wires.

    Args:
        name: of the circuit.
        wires: n.
        spectral: S, the number of encodings, where there are `Rotations`.
        sublayers: L, the sublayers of each of the S + 1 trainable blocks, where there are `Rotations`. Their angles are
            `weights1` (S, L, n, 3) and `weights2` (L, n, 3). One after the other they are (rows, n, 3), with the row
            r = block * L + sublayer.
        operations: in the order in which they act on `|0...0>`.
        observables: at least one. A Pauli word or a `Hamiltonian` is one output, its expectation value; `Probabilities`
            of k wires are 2^k. Wire 0 is the most significant bit of a basis state, as in PennyLane.
        features: length of the input; by default n. Lists may stand for tuples.
        weights: the trainable weights of the gates. The weights of `Rotations` need no entry.

    Raises:
        ValueError: an operation, row, wire, gate, axis, weight, feature or Pauli letter that does not exist, or no
            observable.
    """

    name: str
    wires: int
    spectral: int = 0
    sublayers: int = 0
    operations: tuple[Operation, ...] = ()
    observables: tuple[Observable, ...] = ()
    features: int | None = None
    weights: tuple[Weights, ...] = ()

    def __post_init__(self) -> None:
        check_wires(self.wires)
        kinds: dict[str, Any] = {
            "operations": Operation,
            "weights": Weights,
            "observables": Hamiltonian | Probabilities,
        }
        for name, kind in kinds.items():
            value = getattr(self, name)
            object.__setattr__(self, name, (value,) if isinstance(value, kind) else tuple(value))
        object.__setattr__(self, "observables", tuple(map(_as_observable, self.observables)))
        if self.features is None:
            object.__setattr__(self, "features", self.wires)
        elif isinstance(self.features, bool) or not isinstance(self.features, int) or self.features < 0:
            raise self._error(f"features must be an integer of at least 0, got {self.features!r}")
        if self.sublayers or self.spectral or any(isinstance(op, Rotations) for op in self.operations):
            for name, value in (("spectral layers", self.spectral), ("sublayers", self.sublayers)):
                if value < 1:
                    raise self._error(f"{name} must be at least 1, got {value}")
        names = [weights.name for weights in self.weights]
        if len({*names, "weights1", "weights2"}) < len(names) + 2:
            raise self._error(f"weights need different names, other than weights1 and weights2, got {names}")
        started: set[int] = set()
        for operation in self.operations:
            self._check(operation, started)
        if not self.observables:
            raise self._error("needs at least one observable")
        for observable in self.observables:
            self._check_observable(observable)

    def _error(self, message: str) -> ValueError:
        return ValueError(f"ansatz {self.name}: {message}")

    def _check(self, operation: Operation, started: set[int]) -> None:
        """ValueError unless the operation fits; `started` are the wires that earlier ones act on."""
        n, rows = self.wires, self.rows
        if not isinstance(operation, Operation):
            known = ", ".join(kind.__name__ for kind in get_args(Operation))
            raise self._error(f"unknown operation {operation!r}; known: {known}")
        if isinstance(operation, Gate | Amplitudes):
            self._check_gate(operation, started)
            started.update(operation.wires)
            return
        started.update(range(n))
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
            if self.features != n:
                raise self._error(f"encoding needs a feature for each of {n} wires, got features={self.features}")

    def _check_gate(self, operation: Gate | Amplitudes, started: set[int]) -> None:
        sizes = {weights.name: weights.size for weights in self.weights}
        what = operation.name if isinstance(operation, Gate) else "amplitudes"
        if not all(0 <= wire < self.wires for wire in operation.wires):
            raise self._error(f"{what} on wires {operation.wires} needs wires below {self.wires}")
        if isinstance(operation, Amplitudes) and started & set(operation.wires):
            raise self._error(f"amplitudes of wires {operation.wires} must come before every gate on these wires")
        for angle in map(Expression.of, operation.angles):
            if any(not 0 <= index < (self.features or 0) for index in angle.features):
                raise self._error(f"{what} takes the angle {angle}, the input has {self.features} features")
            if any(not 0 <= index < sizes.get(name, 0) for name, index in angle.weights):
                known = ", ".join(f"{name} with {size}" for name, size in sizes.items()) or "none"
                raise self._error(f"{what} takes the angle {angle}; declared weights: {known}")

    def _check_observable(self, observable: Observable) -> None:
        known = f"wires below {self.wires}, letters {', '.join(PAULIS)}"
        if isinstance(observable, Probabilities):
            wires = observable.wires
            if not wires or len(set(wires)) < len(wires) or not all(0 <= wire < self.wires for wire in wires):
                raise self._error(f"probabilities of wires {wires} need different {known.split(',')[0]}")
            return
        for word in as_sum(observable).words:
            if len({wire for wire, _ in word}) < len(word):
                raise self._error(f"observable {word} has more than one letter on a wire")
            if any(not 0 <= wire < self.wires or letter not in PAULIS for wire, letter in word):
                raise self._error(f"observable {word} needs {known}")

    @property
    def outputs(self) -> int:
        """Number of outputs."""
        return sum(map(values_of, self.observables))

    @property
    def rows(self) -> int:
        """Rows of the weights of `Rotations`, (S + 1) L."""
        return (self.spectral + 1) * self.sublayers

    @property
    def weight_shapes(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Shapes of `weights1` and `weights2`."""
        return (self.spectral, self.sublayers, self.wires, 3), (self.sublayers, self.wires, 3)

    @property
    def parameters(self) -> dict[str, tuple[int, ...]]:
        """Name -> shape of all trainable weights; the weights of `Rotations` come first."""
        stacked = dict(zip(("weights1", "weights2"), self.weight_shapes, strict=True)) if self.sublayers else {}
        return stacked | {weights.name: weights.shape for weights in self.weights}

    @property
    def size(self) -> int:
        """Number of trainable weights."""
        return sum(map(prod, self.parameters.values()))

    @cached_property
    def reuploading(self) -> bool:
        """Whether all operations are of data re-uploading circuits, and all wires can be measured in the same shot.

        The engines of `normal_form` take these circuits.
        """
        letters: dict[int, str] = {}
        return (
            self.sublayers > 0
            and not self.weights
            and self.features == self.wires
            and all(isinstance(operation, Rotations | Entangler | Encoding) for operation in self.operations)
            and all(isinstance(word, tuple) for word in self.observables)
            and all(
                letters.setdefault(w, a) == a for word in self.observables if isinstance(word, tuple) for w, a in word
            )
        )

    @property
    def words(self) -> tuple[PauliWord, ...]:
        """The measured Pauli words of a circuit that measures nothing else.

        Raises:
            ValueError: the circuit measures Hamiltonians or probabilities.
        """
        words = tuple(word for word in self.observables if isinstance(word, tuple))
        if len(words) < len(self.observables):
            raise self._error("measures Hamiltonians or probabilities; this takes Pauli words alone")
        return words


def check_wires(wires: int) -> None:
    """ValueError unless 1 <= wires <= 1024, the width of a circuit."""
    if isinstance(wires, bool) or not isinstance(wires, int) or not 1 <= wires <= MAX_WIRES:
        raise ValueError(f"wires must be an integer in 1..{MAX_WIRES}, got {wires!r}")


def check_state(wires: int, what: str) -> None:
    """ValueError if there are more than 20 wires. The message says how much memory one state would take."""
    if wires > MAX_STATE_WIRES:
        size = readable_bytes(16 * 2.0**wires)
        raise ValueError(
            f"{what}: one state of {wires} wires takes {size} of memory in float64; a state has at most"
            f" {MAX_STATE_WIRES} wires; a wider circuit re-uploads data, and its outputs depend on few wires"
        )


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


VARIANTS: dict[str, dict[str, Any]] = {
    "cnot": {"entangler": "CNOT"},  # as StronglyEntanglingLayers has it by default
    "neighbours": {"ranges": (1, 1)},  # light cones are narrower
    "ternary": {"scaling": "ternary"},
    "rx": {"axis": "X"},
    "ry": {"axis": "Y"},
    "pauli_x": {"observable": "X"},  # the last ring then has an effect, which a measurement of Z would not see
}
"""QIREN with other options: name -> options of `qiren`."""


def _register_variant(name: str) -> None:
    @ANSATZE.register(name)
    def variant(wires: int, spectral: int) -> Circuit:
        return replace(qiren(wires, spectral, **VARIANTS[name]), name=name)


for _name in VARIANTS:
    _register_variant(_name)
