"""PennyLane's tapes as circuits: what `from_qnode` and the device `qnerf.fast` share.

A tape is a list of operations and of measurements. PennyLane's own decompositions reduce the operations to the gates of
`gates.GATES`. What a measurement needs of the state is a few Pauli words or probabilities; `Measured` combines them.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
import pennylane as qml
import torch
from torch import Tensor

from qnerf.quantum.circuit import Amplitudes, Circuit, Gate, Operation, PauliWord, Probabilities, Weights
from qnerf.quantum.expressions import Expression
from qnerf.quantum.gates import GATES, SHORT_NAMES

WITHOUT_EFFECT = frozenset({"Identity", "GlobalPhase", "Barrier", "WireCut"})
STATES = frozenset({"StatePrep", "AmplitudeEmbedding"})
MEASUREMENTS = (qml.measurements.ExpectationMP, qml.measurements.VarianceMP, qml.measurements.ProbabilityMP)
REFUSED = {"MidMeasureMP": "qml.defer_measurements replaces measurements in the middle of a circuit"}
KNOWN_MEASUREMENTS = "expval, var, probs"
MAX_MATRIX_WIRES = 6  # of an operation or an observable that is a matrix: it has 4^wires entries

Read = Callable[[Any], Expression]


def is_gate(operation: Any) -> bool:
    """Whether the operation needs no decomposition."""
    name = operation.name
    return name in WITHOUT_EFFECT or name in STATES or SHORT_NAMES.get(name, name) in GATES


def is_measurement(measurement: Any) -> bool:
    """Whether the measurement can be computed: expectation values, variances and probabilities."""
    return isinstance(measurement, MEASUREMENTS) and measurement.mv is None


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
        if operation.name in REFUSED or isinstance(operation, qml.operation.Channel):
            advice = REFUSED.get(
                operation.name, "noise is an argument of QuantumLayer, and default.mixed takes channels"
            )
            raise ValueError(f"{operation.name} is no gate; {advice}")
        try:
            parts = _controlled_rotation(operation) or _decomposition(operation)
        except Exception as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise ValueError(f"{operation.name} does not decompose into gates of qnerf: {reason}") from error
        yield from decomposed(parts, used)


def _decomposition(operation: Any) -> list[Any]:
    if not operation.has_decomposition and operation.has_matrix and len(operation.wires) <= MAX_MATRIX_WIRES:
        return [qml.QubitUnitary(operation.matrix(), wires=operation.wires)]
    parts: list[Any] = operation.decomposition()
    return parts


def _controlled_rotation(operation: Any) -> list[Any]:
    """A rotation with one control, which PennyLane's own decomposition takes only with numbers as angles."""
    if not isinstance(operation, qml.ops.Controlled) or len(operation.control_wires) != 1:
        return []
    if operation.base.name not in {"RX", "RY", "RZ", "Rot", "PhaseShift"}:
        return []
    flips = [] if operation.control_values[0] else [qml.X(operation.control_wires)]
    return [*flips, qml.ctrl(operation.base, operation.control_wires), *flips]


def described(operations: Iterable[Any], places: dict[Any, int], read: Read) -> tuple[Operation, ...]:
    """Gates of PennyLane as operations. `places` numbers the wires; `read` turns a parameter into an expression."""
    out: list[Operation] = []
    for operation in operations:
        name, wires = operation.name, tuple(places[wire] for wire in operation.wires)
        if name in WITHOUT_EFFECT:
            continue
        if name in STATES:
            out.append(_amplitudes(operation.parameters[0], wires, read))
            continue
        word = operation.hyperparameters["pauli_word"] if name == "PauliRot" else ""
        angles = tuple(read(parameter) for parameter in operation.parameters)
        out.append(Gate(SHORT_NAMES.get(name, name), wires, angles, word))
    return tuple(out)


def _amplitudes(state: Any, wires: tuple[int, ...], read: Read) -> Amplitudes:
    columns = [state[..., index] for index in range(2 ** len(wires))]
    if qml.math.get_dtype_name(state).startswith("complex"):
        real, imaginary = ([read(part(column)) for column in columns] for part in (qml.math.real, qml.math.imag))
        return Amplitudes(wires, tuple(real), tuple(imaginary))
    return Amplitudes(wires, tuple(map(read, columns)))


class Measured:
    """Measurements of a tape as outputs of a circuit.

    Args:
        measurements: of the tape.
        places: the number of each wire.

    Raises:
        ValueError: a measurement or an observable that cannot be computed, by its name.
    """

    def __init__(self, measurements: Iterable[Any], places: dict[Any, int]) -> None:
        self.words: dict[PauliWord, int] = {}
        self.tables: list[Probabilities] = []
        self.parts: list[tuple[str, Any]] = []
        for measurement in measurements:
            if not is_measurement(measurement):
                name = type(measurement).__name__.removesuffix("MP")
                raise ValueError(f"the measurement {name} is not computed; known: {KNOWN_MEASUREMENTS}")
            if isinstance(measurement, qml.measurements.ProbabilityMP):
                if measurement.obs is not None:
                    raise ValueError(f"probabilities of {measurement.obs.name} are not supported; give wires")
                wires = tuple(places[wire] for wire in measurement.wires) or tuple(places.values())
                self.tables.append(Probabilities(wires))
                self.parts.append(("probabilities", len(self.tables) - 1))
                continue
            sentence = _sentence(measurement.obs)
            if isinstance(measurement, qml.measurements.VarianceMP):
                self.parts.append(
                    ("variance", (self._terms(sentence, places), self._terms(sentence @ sentence, places)))
                )
            else:
                self.parts.append(("mean", self._terms(sentence, places)))

    def _terms(self, sentence: Any, places: dict[Any, int]) -> list[tuple[Any, int | None]]:
        """Each coefficient with the place of its word; None for the identity."""
        terms: list[tuple[Any, int | None]] = []
        for word, coefficient in sentence.items():
            letters = tuple(sorted((places[wire], letter) for wire, letter in word.items()))
            terms.append((coefficient, self.words.setdefault(letters, len(self.words)) if letters else None))
        return terms

    @property
    def observables(self) -> tuple[PauliWord | Probabilities, ...]:
        """What the circuit measures: a constant if nothing else is asked for."""
        return (*self.words, *self.tables) or ((),)

    @property
    def key(self) -> Any:
        return tuple(self.words), tuple(self.tables)

    def results(self, values: Tensor) -> list[Tensor]:
        """The measurements, (B,) or (B, 2^k) each, from the circuit's outputs (B, outputs)."""
        firsts = np.cumsum([len(self.words), *(2 ** len(table.wires) for table in self.tables)])
        out = []
        for kind, part in self.parts:
            if kind == "probabilities":
                out.append(values[:, firsts[part] : firsts[part + 1]])
            elif kind == "mean":
                out.append(_combined(part, values))
            else:
                out.append(_combined(part[1], values) - _combined(part[0], values).square())
        return out


def _combined(terms: list[tuple[Any, int | None]], values: Tensor) -> Tensor:
    if len(terms) == 1 and terms[0][1] is not None and isinstance(terms[0][0], float) and terms[0][0] == 1:
        return values[:, terms[0][1]]
    total = values.new_zeros(values.shape[0])
    for coefficient, place in terms:
        factor = coefficient.real.to(values) if torch.is_tensor(coefficient) else float(np.real(coefficient))
        total = total + (factor if place is None else factor * values[:, place])
    return total


def _sentence(observable: Any) -> Any:
    """The observable as a sum of Pauli words."""
    if observable.pauli_rep is not None:
        return observable.pauli_rep
    if not observable.has_matrix or len(observable.wires) > MAX_MATRIX_WIRES:
        raise ValueError(f"the observable {observable.name} has no Pauli words")
    return qml.pauli_decompose(qml.matrix(observable), wire_order=observable.wires, pauli=True)


def places_of(tape: Any, labels: Any) -> dict[Any, int]:
    """A number for each wire of a tape; `labels` are the wires of the device, or None."""
    everything = labels is not None and any(not measurement.wires for measurement in tape.measurements)
    return {wire: place for place, wire in enumerate(labels if everything else tape.wires)}


def circuit_of(
    operations: tuple[Operation, ...], measured: Measured, wires: int, features: int, weights: tuple[Weights, ...]
) -> Circuit:
    """The circuit of a tape."""
    return Circuit(
        "tape", wires, operations=operations, observables=measured.observables, features=features, weights=weights
    )
