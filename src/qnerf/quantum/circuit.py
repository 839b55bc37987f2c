"""Circuits: a list of gates and what is measured at the end, as plain data; and circuits by name.

Every engine, the drawing and the PennyLane circuit are derived from this description. Each angle is a number, a
trainable weight, a feature of the input or a polynomial of them:

>>> from qnerf.quantum.expressions import feature
>>> w = Weights("w", (2,))
>>> mine = Circuit(
...     "mine", wires=2, features=3, weights=(w,),
...     operations=(Gate("H", (0,)), Gate("RY", (1,), (w[0] * feature(2),)), Gate("IsingXX", (0, 1), (w[1],))),
...     observables=(((0, "X"),), Hamiltonian((0.5, -1.0), (((0, "Z"), (1, "Z")), ((0, "X"),))), Probabilities((1,))),
... )
>>> mine.outputs, mine.parameters
(4, {'w': (2,)})

`rotations`, `entanglers` and `encoding` are lists of gates on many wires at once:

>>> w = Weights("w", (2, 2, 3))
>>> bell = Circuit(
...     "bell", wires=2, weights=(w,),
...     operations=(rotations(w[0]), entanglers("CNOT", ((0, 1),)), encoding("Z", (1.0, 2.0)), rotations(w[1])),
...     observables=(((0, "Z"), (1, "Z")),),
... )
>>> bell.operations[2:5]
(Gate(name='CNOT', wires=(0, 1), angles=(), word=''), Gate(name='RZ', wires=(0,), angles=(x[0],), word=''), \
Gate(name='RZ', wires=(1,), angles=(2*x[1],), word=''))

`ANSATZE` holds the circuits that have a name. A new one is a function of the wires and the spectral layers that returns
a `Circuit`; its keyword-only parameters are options that a configuration can set:

    @ANSATZE.register("mine")
    def mine(wires: int, spectral: int, *, axis: str = "Y") -> Circuit:
        return replace(qiren(wires, spectral, entangler="CNOT", axis=axis), name="mine")
"""

from collections.abc import Iterable, Iterator
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
PAULIS = get_args(Pauli)

PauliWord = tuple[tuple[int, str], ...]
"""A product of Pauli operators as (wire, letter) pairs. Wires that are left out carry the identity."""


Operation = Gate | Amplitudes


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
        operations: in the order in which they act on `|0...0>`: gates, `Amplitudes`, or lists of them.
        observables: at least one. A Pauli word or a `Hamiltonian` is one output, its expectation value; `Probabilities`
            of k wires are 2^k. Wire 0 is the most significant bit of a basis state, as in PennyLane.
        features: length of the input; by default n. Lists may stand for tuples.
        weights: the trainable weights of the gates.

    Raises:
        ValueError: an operation, wire, weight, feature or Pauli letter that does not exist, or no observable.
    """

    name: str
    wires: int
    operations: tuple[Operation, ...] = ()
    observables: tuple[Observable, ...] = ()
    features: int | None = None
    weights: tuple[Weights, ...] = ()

    def __post_init__(self) -> None:
        check_wires(self.wires)
        object.__setattr__(self, "operations", tuple(_flat(self.operations)))
        for name, kind in (("weights", Weights), ("observables", Hamiltonian | Probabilities)):
            value = getattr(self, name)
            object.__setattr__(self, name, (value,) if isinstance(value, kind) else tuple(value))
        object.__setattr__(self, "observables", tuple(map(_as_observable, self.observables)))
        if self.features is None:
            object.__setattr__(self, "features", self.wires)
        elif isinstance(self.features, bool) or not isinstance(self.features, int) or self.features < 0:
            raise self._error(f"features must be an integer of at least 0, got {self.features!r}")
        names = [weights.name for weights in self.weights]
        if len(set(names)) < len(names):
            raise self._error(f"weights need different names, got {names}")
        started: set[int] = set()
        sizes = {weights.name: weights.size for weights in self.weights}
        for operation in self.operations:
            if not isinstance(operation, Operation):
                known = ", ".join(kind.__name__ for kind in get_args(Operation))
                raise self._error(f"unknown operation {operation!r}; known: {known}")
            self._check_gate(operation, started, sizes)
            started.update(operation.wires)
        if not self.observables:
            raise self._error("needs at least one observable")
        for observable in self.observables:
            self._check_observable(observable)

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        return hash((self.name, self.wires, self.operations, self.observables, self.features, self.weights))

    def _error(self, message: str) -> ValueError:
        return ValueError(f"ansatz {self.name}: {message}")

    def _check_gate(self, operation: Operation, started: set[int], sizes: dict[str, int]) -> None:
        """ValueError unless the operation fits; `started` are the wires that earlier ones act on."""
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
    def gates(self) -> list[Gate]:
        """All gates in order, without the `Amplitudes`."""
        return [operation for operation in self.operations if isinstance(operation, Gate)]

    @property
    def parameters(self) -> dict[str, tuple[int, ...]]:
        """Name -> shape of all trainable weights."""
        return {weights.name: weights.shape for weights in self.weights}

    @property
    def size(self) -> int:
        """Number of trainable weights."""
        return sum(map(prod, self.parameters.values()))

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


def _flat(operations: Any) -> Iterator[Any]:
    """The operations of a list that may hold lists of them."""
    for operation in (operations,) if isinstance(operations, Operation) else operations:
        if isinstance(operation, list | tuple):
            yield from _flat(operation)
        else:
            yield operation


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


def rotations(angles: Iterable[Iterable[Expression]]) -> list[Gate]:
    """Rot(phi, theta, omega) = RZ(omega) RY(theta) RZ(phi) on every wire, by its three angles in radians."""
    return [Gate("Rot", (wire,), tuple(own)) for wire, own in enumerate(angles)]


def entanglers(gate: str, pairs: Iterable[tuple[int, int]]) -> list[Gate]:
    """`gate` (CZ or CNOT) on each pair of wires (control, target), in this order."""
    return [Gate(gate, pair) for pair in pairs]


def encoding(axis: str, scales: Iterable[float]) -> list[Gate]:
    """A rotation about `axis` (X, Y or Z) on every wire j, by the angle `scales[j]` x_j in radians."""
    return [Gate(f"R{axis}", (wire,), (scale * feature(wire),)) for wire, scale in enumerate(scales)]


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
    first, last = Weights("weights1", (spectral, sublayers, wires, 3)), Weights("weights2", (sublayers, wires, 3))
    operations: list[Gate] = []
    for block in range(spectral + 1):
        for layer, distance in enumerate(distances):
            operations += rotations(first[block, layer] if block < spectral else last[layer])
            operations += entanglers(entangler, ring(wires, distance))
        if block < spectral:
            operations += encoding(axis, (scale * (3.0**block if scaling == "ternary" else 1.0),) * wires)
    observables = tuple(((wire, observable),) for wire in range(wires))
    return Circuit("qiren", wires, tuple(operations), observables, weights=(first, last))


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
