"""PennyLane's tapes as circuits: what `from_qnode` and the device `qnerf.fast` share.

A tape is a list of operations and of measurements. PennyLane's own decompositions reduce the operations to the gates of
`gates.GATES`. They run on expressions in place of the tape's numbers, once for all tapes that differ in numbers alone.
An operation without tensors whose decomposition needs numbers, such as a fixed matrix, is decomposed once for its
numbers. With tensors, its decomposition at the numbers of one call has no derivative where it branches, so that
operation is left to PennyLane. Expectation values and variances are outputs of the circuit as Hamiltonians.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from math import prod
from typing import Any, NamedTuple

import numpy as np
import pennylane as qml
import torch
from torch import Tensor

from qnerf.quantum.circuit import (
    Amplitudes,
    Circuit,
    Gate,
    Hamiltonian,
    Observable,
    Operation,
    Probabilities,
    Weights,
    values_of,
)
from qnerf.quantum.expressions import Expression, feature, weight
from qnerf.quantum.gates import GATES, SHORT_NAMES
from qnerf.quantum.simulator import Simulator

WITHOUT_EFFECT = frozenset({"Identity", "GlobalPhase", "Barrier", "WireCut"})
STATES = frozenset({"StatePrep", "AmplitudeEmbedding"})
OWN = {getattr(qml, name) for name in (*GATES, *SHORT_NAMES, *WITHOUT_EFFECT, *STATES)}
"""PennyLane's classes that need no decomposition. A class of the same name may compute something else."""
PARTS = (qml.ops.Prod, qml.MERA, qml.TTN, qml.MPS)
"""Operations that are taken apart first: their parts may batch their own numbers, or be made by a user's function."""
LARGEST_MATRIX = 3  # wires of a fixed matrix that is decomposed; a larger one takes more gates than it saves
CHECKED_WIRES = 6  # of operations whose decomposition at their numbers is compared with their matrix
MEASUREMENTS = (qml.measurements.ExpectationMP, qml.measurements.VarianceMP, qml.measurements.ProbabilityMP)
KNOWN_MEASUREMENTS = "expval, var, probs"
MAX_CACHED = 256  # circuits, and lists of measurements
NUMBERS = (float, int, complex, np.number, np.ndarray, Tensor)
SINGLE = frozenset({torch.float32, torch.complex64})

_described: dict[Any, "Described"] = {}
_fixed: dict[Any, tuple[Any, ...]] = {}
_expressible: dict[Any, bool] = {}
_measured: dict[Any, "Measured"] = {}
_engines: dict[Any, Simulator] = {}


@dataclass(frozen=True, eq=False)
class Described:
    """Operations on expressions, or why there are none. Compared by identity, as a key."""

    operations: tuple[Operation, ...]
    reason: str = ""


class Execution(NamedTuple):
    """A tape with the engine that evaluates it."""

    engine: Simulator
    numbers: "Numbers"
    measured: "Measured"

    def results(self) -> list[Tensor]:
        """Each measurement: () or (2^k,), with a batch (B,) or (B, 2^k); float32 if all tensors of the tape are."""
        results = self.measured.results(self.engine(*self.numbers.tensors()))
        return [value[0] for value in results] if self.numbers.batch is None else results


def execution_of(tape: Any, labels: Any) -> Execution:
    """How to evaluate a tape, exactly.

    Args:
        tape: of PennyLane; some of its parameters may hold a number for each sample of a batch.
        labels: the wires of the device, None if it takes any.

    Raises:
        ValueError: an operation, a parameter or a measurement that no engine takes, by its name.
    """
    if tape.shots:
        raise ValueError("finite shots are not computed")
    if labels is not None and not labels.contains_wires(tape.wires):
        raise ValueError(f"wires {tape.wires.tolist()} on a device with wires {labels.tolist()}")
    places = places_of(tape, labels)
    measured = _measurements_of(tape, places)
    numbers, described = _described_by(tape, places)
    key = described, measured.observables
    engine = _remembered(_engines, key, lambda: _engine(described, measured, len(places), numbers))
    return Execution(engine, numbers, measured)


def _remembered(known: dict[Any, Any], key: Any, make: Callable[[], Any]) -> Any:
    found = known.get(key)
    if found is None:
        if len(known) >= MAX_CACHED:
            known.clear()
        found = known[key] = make()
    return found


def _engine(described: Described, measured: "Measured", wires: int, numbers: "Numbers") -> Simulator:
    own = (Weights("parameters", (numbers.count[False],)),) if numbers.count[False] else ()
    observables, features = measured.observables, numbers.count[True]
    return Simulator(Circuit("tape", max(wires, 1), described.operations, observables, features, own))


def _described_by(tape: Any, places: dict[Any, int]) -> "tuple[Numbers, Described]":
    """The tape's numbers, and operations whose angles are expressions of them."""
    numbers = Numbers(part for operation in tape.operations for part in _fixed_parts(operation))
    try:
        found = _remembered(_described, (numbers.key, *places), lambda: _on_expressions(numbers, places))
    except TypeError as error:  # a structure without a hash
        raise ValueError(str(error)) from error
    if found.reason:
        raise ValueError(found.reason)
    return numbers, found


def _on_expressions(numbers: "Numbers", places: dict[Any, int]) -> Described:
    try:
        return Described(numbers.described(places))
    except Exception as error:  # whatever a decomposition meets that has expected numbers
        return Described((), _one_line(error))


def _one_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def _fixed_parts(operation: Any) -> tuple[Any, ...]:
    """The operation; its decomposition if it is not PennyLane's, or holds no tensor and decomposes at numbers only.

    Raises:
        ValueError: an operation that only its matrix describes.
    """
    if type(operation) in OWN:
        return (operation,)
    foreign = not type(operation).__module__.startswith("pennylane.")
    if foreign and (getattr(operation, "has_matrix", False) or not getattr(operation, "has_decomposition", False)):
        raise ValueError(f"{operation.name} is an operation with a matrix of its own")
    if foreign or isinstance(operation, PARTS):
        return tuple(part for own in operation.decomposition() for part in _fixed_parts(own))
    leaves, structure = qml.pytrees.flatten(operation)
    try:
        key = structure, *map(_constant, leaves)
        expressible = _remembered(_expressible, structure, lambda: _is_expressible(operation))
    except (TypeError, ValueError):  # tensors, or a structure without a hash
        return (operation,)
    return (operation,) if expressible else _remembered(_fixed, key, lambda: _at_numbers(operation))


def _is_expressible(operation: Any) -> bool:
    try:
        return not _on_expressions(Numbers([operation]), places_of(operation, operation.wires)).reason
    except ValueError:
        return False


def _at_numbers(operation: Any) -> tuple[Any, ...]:
    """The gates of an operation of fixed numbers. ValueError if they are not the operation to rounding."""
    parts = tuple(decomposed([operation]))
    if operation.has_matrix and len(operation.wires) <= CHECKED_WIRES:
        expected = qml.matrix(operation, wire_order=operation.wires)
        found = qml.matrix(qml.tape.QuantumScript(parts), wire_order=operation.wires)
        overlap = np.vdot(found, expected)
        if np.abs(found * overlap / abs(overlap) - expected).max() > 1e-13 * len(expected):
            raise ValueError(f"{operation.name} is not the product of its gates to rounding")
    return parts


class Numbers:
    """The parameters of operations. One for each sample is a feature of a circuit, any other one is a weight.

    Args:
        operations: of a tape.

    Raises:
        ValueError: a parameter that is no number, array or tensor of PyTorch.
    """

    def __init__(self, operations: Iterable[Any]) -> None:
        self.count = {False: 0, True: 0}  # of the weights, of the features
        self.batch: int | None = None
        self._values: dict[bool, list[Any]] = {False: [], True: []}
        self._slots: dict[tuple[int, bool], Slot] = {}
        self._operations: list[tuple[Any, tuple[Slot, ...]]] = []
        self.key = tuple(map(self._taken, operations))

    def _taken(self, operation: Any) -> Any:
        """What tells the operation apart from others that differ in more than numbers."""
        name = operation.name
        leaves, structure = operation.data, (name, operation.wires.labels)
        if not is_gate(operation) or name == "PauliRot":
            leaves, structure = qml.pytrees.flatten(operation)
        if len(leaves) != len(operation.data):
            raise ValueError(f"{name} has parameters that are no numbers")
        slots = tuple(self._slot(operation, place, leaf) for place, leaf in enumerate(leaves))
        if name in STATES and not operation.hyperparameters["normalize"]:
            raise ValueError(f"{name} without normalize=True is taken as it is")
        self._operations.append((operation, slots))
        return structure, slots

    def _slot(self, operation: Any, place: int, value: Any) -> "Slot":
        if not isinstance(value, NUMBERS):
            raise ValueError(f"{operation.name} has a parameter of type {type(value).__name__}")
        shape = tuple(getattr(value, "shape", ()))
        batched = _is_batched(operation, place, len(shape))
        known = self._slots.get((id(value), batched))
        if known is not None:
            return known
        if "complex" in str(getattr(value, "dtype", type(value))):
            raise ValueError(f"{operation.name} has complex parameters")
        slot = Slot(batched, self.count[batched], shape[batched:])
        self.count[batched] += prod(slot.shape)
        if batched and self.batch not in (None, shape[0]):
            raise ValueError(f"batches of {self.batch} and of {shape[0]} samples")
        self.batch = shape[0] if batched else self.batch
        self._values[batched].append(value)
        if torch.is_tensor(value):  # the same tensor twice: features and weights that two operations share
            self._slots[id(value), batched] = slot
        return slot

    def described(self, places: dict[Any, int]) -> tuple[Operation, ...]:
        """The operations with expressions as angles."""
        return described(decomposed(_bound(*own) for own in self._operations), places)

    @property
    def is_torch(self) -> bool:
        """Whether one of them is a tensor of PyTorch."""
        return any(map(torch.is_tensor, chain(*self._values.values())))

    def tensors(self) -> tuple[Tensor, Tensor]:
        """The features (B, features) and the flat weights."""
        given = [value for value in chain(*self._values.values()) if torch.is_tensor(value)]
        dtype = torch.float32 if given and all(value.dtype in SINGLE for value in given) else torch.float64
        device = given[0].device if given else torch.device("cpu")

        def joined(batched: bool, rows: int) -> Tensor:
            values = [_tensor(value).to(device) for value in self._values[batched]]
            if not values:
                return torch.zeros(rows, 0, dtype=dtype, device=device)
            if all(value.ndim == batched for value in values):
                return torch.stack([value.to(dtype) for value in values], -1).reshape(rows, -1)
            flat = [value.to(dtype).reshape(rows, -1) for value in values]
            return torch.cat(flat, 1) if len(flat) > 1 else flat[0]

        return joined(True, 1 if self.batch is None else self.batch), joined(False, 1)[0]


def _is_batched(operation: Any, place: int, dimensions: int) -> bool:
    """Whether a parameter has an entry for each sample."""
    if not dimensions:
        return False
    known: Any = getattr(operation, "ndim_params", None)  # a product below a control or an adjoint has none
    if known is None:
        raise ValueError(f"{operation.name} does not say which of its parameters are batches")
    expected = known[place]
    if dimensions not in (expected, expected + 1):
        raise ValueError(f"{operation.name} has a parameter with {dimensions} dimensions")
    return bool(dimensions > expected)


def _tensor(value: Any) -> Tensor:
    return value if torch.is_tensor(value) else torch.as_tensor(np.asarray(value))


def _bound(operation: Any, slots: tuple["Slot", ...]) -> Any:
    """The operation on expressions in place of its numbers."""
    entries = [slot.expressions() for slot in slots]
    if operation.name in STATES:
        return qml.StatePrep(entries[0], wires=operation.wires)
    return qml.pytrees.unflatten(entries, qml.pytrees.flatten(operation)[1])


class Slot(NamedTuple):
    """Where the entries of a parameter lie among the features or the weights."""

    is_feature: bool
    first: int
    shape: tuple[int, ...]

    def expressions(self) -> Any:
        """An array of expressions."""
        out = np.empty(self.shape, dtype=object)
        for place, index in enumerate(np.ndindex(*self.shape), start=self.first):
            out[index] = feature(place) if self.is_feature else weight("parameters", place)
        return out if self.shape else out[()]


def is_gate(operation: Any) -> bool:
    """Whether the operation needs no decomposition."""
    return type(operation) in OWN


def decomposed(operations: Iterable[Any], used: set[Any] | None = None) -> Iterator[Any]:
    """The operations, reduced to gates; a state is prepared by gates on wires that are `used` already.

    Raises:
        ValueError: an operation that does not decompose into gates.
    """
    used = set() if used is None else used
    for operation in operations:
        if is_gate(operation) and not (operation.name in STATES and used & set(operation.wires)):
            used.update(operation.wires)
            yield operation
            continue
        if isinstance(operation, qml.Snapshot) or not isinstance(operation, qml.operation.Operator):
            raise ValueError(f"{operation.name} is no gate")
        if isinstance(operation, qml.QubitUnitary) and len(operation.wires) > LARGEST_MATRIX:
            raise ValueError(f"{operation.name} of {len(operation.wires)} wires is a matrix, not gates")
        try:
            parts = operation.decomposition()
        except Exception as error:
            reason = f"{operation.name} does not decompose into gates of qnerf: {_one_line(error)}"
            raise ValueError(reason) from error
        yield from decomposed(parts, used)


def described(operations: Iterable[Any], places: dict[Any, int]) -> tuple[Operation, ...]:
    """Gates of PennyLane, with expressions as angles, as operations of a circuit. `places` numbers the wires."""
    out: list[Operation] = []
    for operation in operations:
        name, wires = operation.name, tuple(places[wire] for wire in operation.wires)
        if name in WITHOUT_EFFECT:
            continue
        if name in STATES:
            out.append(Amplitudes(wires, tuple(operation.parameters[0])))
            continue
        word = operation.hyperparameters["pauli_word"] if name == "PauliRot" else ""
        angles = tuple(_angle(parameter) for parameter in operation.parameters)
        out.append(Gate(SHORT_NAMES.get(name, name), wires, angles, word))
    return tuple(out)


def _angle(parameter: Any) -> Expression:
    if isinstance(parameter, Expression):
        return parameter
    values = np.asarray(parameter, dtype=object).reshape(-1)
    if len(values) != 1:
        raise ValueError(f"an angle expects one number for each sample, got {len(values)}")
    return Expression.of(values[0])


def places_of(tape: Any, labels: Any) -> dict[Any, int]:
    """A number for each wire of a tape; `labels` are the wires of the device, or None."""
    measurements = getattr(tape, "measurements", ())
    everything = labels is not None and any(not measurement.wires for measurement in measurements)
    wires = list(labels if everything else tape.wires)
    if not everything and set(wires) == set(range(len(wires))):  # PennyLane's order, whichever is used first
        wires = list(range(len(wires)))
    return {wire: place for place, wire in enumerate(wires)}


def _measurements_of(tape: Any, places: dict[Any, int]) -> "Measured":
    leaves, structure = qml.pytrees.flatten(tape.measurements)
    key = structure, *map(_constant, leaves), *places
    try:
        hash(key)
    except TypeError as error:
        raise ValueError(f"a measurement with a parameter of {error}") from error
    return _remembered(_measured, key, lambda: Measured(tape.measurements, places))


def _constant(value: Any) -> Any:
    """What stands for the value in a key."""
    if isinstance(value, np.ndarray):
        return value.shape, value.dtype.str, value.tobytes()
    if torch.is_tensor(value) or not (value is None or isinstance(value, NUMBERS)):
        raise ValueError(f"a measurement has a parameter of type {type(value).__name__}; known: numbers")
    return value


class Measured:
    """Measurements of a tape as outputs of a circuit.

    Args:
        measurements: of the tape.
        places: the number of each wire.

    Raises:
        ValueError: a measurement or an observable that cannot be computed, by its name.
    """

    def __init__(self, measurements: Iterable[Any], places: dict[Any, int]) -> None:
        self.kinds: list[Any] = []
        outputs: list[Observable] = []
        for measurement in measurements:
            if (
                type(measurement) not in MEASUREMENTS
                or measurement.mv is not None
                or (measurement.obs is None and measurement._eigvals is not None)
            ):
                name = type(measurement).__name__.removesuffix("MP")
                raise ValueError(f"the measurement {name} is not computed; known: {KNOWN_MEASUREMENTS}")
            self.kinds.append(type(measurement))
            if isinstance(measurement, qml.measurements.ProbabilityMP):
                if measurement.obs is not None:
                    raise ValueError(f"probabilities of {measurement.obs.name} are not computed; give wires")
                outputs.append(
                    Probabilities(tuple(places[wire] for wire in measurement.wires) or tuple(places.values()))
                )
                continue
            sentence = _sentence(measurement.obs)
            outputs.append(_hamiltonian(sentence, places))
            if isinstance(measurement, qml.measurements.VarianceMP):
                outputs.append(_hamiltonian(sentence @ sentence, places))
        self.observables: tuple[Observable, ...] = tuple(outputs) or ((),)  # a constant if nothing is asked for

    def results(self, values: Tensor) -> list[Tensor]:
        """The measurements, (B,) or (B, 2^k) each, from outputs of the circuit (B, outputs)."""
        parts = iter(values.split(list(map(values_of, self.observables)), 1))
        out = []
        for kind in self.kinds:
            value = next(parts)
            if kind is qml.measurements.VarianceMP:
                value = next(parts) - value.square()
            out.append(value if kind is qml.measurements.ProbabilityMP else value[:, 0])
        return out


def _hamiltonian(sentence: Any, places: dict[Any, int]) -> Hamiltonian:
    words = [tuple(sorted((places[wire], letter) for wire, letter in word.items())) for word in sentence]
    return Hamiltonian(tuple(float(np.real(coefficient)) for coefficient in sentence.values()), tuple(words))


def _sentence(observable: Any) -> Any:
    """The observable as a sum of Pauli words."""
    if observable.pauli_rep is None:
        raise ValueError(f"the observable {observable.name} has no Pauli words")
    return observable.pauli_rep
