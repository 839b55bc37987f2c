"""What the circuits of a run would cost on quantum hardware, where each expectation value takes shots."""

import copy
from typing import Any

import pandas as pd
import torch
from torch import nn

from qnerf.heads.amplitude import System
from qnerf.heads.registers import AmplitudeRegister, BlochRegister
from qnerf.model.model import Model
from qnerf.probes.trained import Trained, heads_of
from qnerf.quantum import QuantumLayer, pennylane
from qnerf.quantum.circuit import (
    Amplitudes,
    Circuit,
    Expression,
    Gate,
    Weights,
    weight,
)

SHOTS = 1000  # of each circuit
RATE = 10_000.0  # shots a second
RAYS = 256
GATE_SET = {
    "CNOT", "CZ", "GlobalPhase", "Hadamard", "PauliX", "PauliY", "PauliZ", "PhaseShift", "RX", "RY", "RZ", "Rot", "S",
    "SX", "T", "U1", "U2", "U3",
}  # fmt: skip


def table(trained: Trained) -> pd.DataFrame:
    """One row for each circuit of each head.

    Columns: head: density or color; circuit: 0, 1, ...; wires; one_qubit_gates, two_qubit_gates and depth, see
    `gate_counts`; view: evaluations of the circuit for one held-out view, all outputs read in the same shots;
    step: evaluations for one training step with the parameter-shift rule; view_hours, step_hours: their time at `SHOTS`
    shots an evaluation and `RATE` shots a second. Sending circuits to the device is not counted.

    Raises:
        ValueError: the run has no circuit, or one that is not a list of gates.
    """
    layers = {(name, place): module for name, head in trained.heads.items() for place, module in _modules(head).items()}
    if not layers:
        raise ValueError(f"{trained.folder}: neither of its heads has a circuit")
    width, height = trained.scene.cameras.size(trained.scene.eval[0])
    in_view = _samples(trained, trained.model)
    in_step = _samples(trained, copy.deepcopy(trained.model).train())  # a copy: its normalisations learn statistics
    rows: list[dict[str, Any]] = []
    for (name, place), module in layers.items():
        circuit = circuit_of(module)
        one, two, depth = gate_counts(circuit)
        view = round(in_view[name, place] * width * height / RAYS)
        step = round(in_step[name, place] * trained.settings.train.rays / RAYS) * shifts(circuit)
        rows.append(
            {
                "head": name,
                "circuit": sum(row["head"] == name for row in rows),
                "wires": circuit.wires,
                "one_qubit_gates": one,
                "two_qubit_gates": two,
                "depth": depth,
                "view": view,
                "step": step,
                "view_hours": view * SHOTS / RATE / 3600,
                "step_hours": step * SHOTS / RATE / 3600,
            }
        )
    return pd.DataFrame(rows)


def gate_counts(circuit: Circuit) -> tuple[int, int, int]:
    """One-qubit gates, two-qubit gates (CNOT and CZ), and depth in gates, after PennyLane's own decompositions.

    A Rot is one gate here; devices with virtual RZ take two pulses for it. Gates on different wires run side by side.
    Any connection between wires is taken to exist. Amplitudes of k wires take 2^k - 2 CNOTs, complex ones twice as many
    (Möttönen et al., arXiv:quant-ph/0407010).

    >>> from qnerf.quantum.circuit import ANSATZE
    >>> gate_counts(ANSATZE.build("qiren", 3, 1))
    (15, 12, 17)
    """
    import pennylane as qml

    generator = torch.Generator().manual_seed(0)  # general values: a gate may be simpler at special ones
    x = torch.rand(circuit.features or 0, generator=generator)
    weights = 0.1 + torch.rand(circuit.size, generator=generator)
    tape = qml.tape.make_qscript(lambda: pennylane.apply(circuit, x, weights))()
    (tape,), _ = qml.transforms.decompose(tape, gate_set=GATE_SET)
    gates = [operation for operation in tape.operations if operation.name != "GlobalPhase"]
    counted = qml.tape.QuantumScript(gates).specs["resources"]
    return counted.gate_sizes.get(1, 0), counted.gate_sizes.get(2, 0), counted.depth


def shifts(circuit: Circuit) -> int:
    """Evaluations for the outputs of one sample and all their derivatives: one, and two for each angle that varies.

    A gate that is several rotations, such as CRX, takes two for each of them (arXiv:1811.11184). Prepared amplitudes
    are differentiated through the 2^k - 1 angles of their preparation, complex ones through twice as many.
    """
    varying = sum(_varies(gate.angle_of(part)) for gate in circuit.gates for part in gate.rotations)
    for operation in circuit.operations:
        if isinstance(operation, Amplitudes) and any(map(_varies, operation.angles)):
            varying += (2 ** len(operation.wires) - 1) * (2 if operation.imaginary else 1)
    return 1 + 2 * varying


def _varies(angle: Expression | float) -> bool:
    return Expression.of(angle).constant is None


def circuit_of(module: QuantumLayer | System) -> Circuit:
    """The circuit of a layer, or of a system of amplitude registers: the preparation of its amplitudes and its gates.

    Raises:
        ValueError: the system's unitary is a matrix and no list of gates.
    """
    if isinstance(module, QuantumLayer):
        return module.circuit
    unitaries, n = module.unitaries, module.wires
    if unitaries.kind in ("dense", "random"):
        raise ValueError(f"cost expects a circuit of gates, got unitary={unitaries.kind}, which is a matrix")
    operations: list[Gate | Amplitudes] = []
    first = used = 0
    for register in module.registers:
        assert isinstance(register, AmplitudeRegister | BlochRegister)
        qubits = register.qubits
        if isinstance(register, BlochRegister):  # RZ(longitude) RY(latitude) on each of them
            operations += [
                gate for wire in range(first, first + qubits)
                for gate in (Gate("RY", (wire,), (weight("w", used),)), Gate("RZ", (wire,), (weight("w", used + 1),)))
            ]  # fmt: skip
            used += 2
        else:
            values = tuple(weight("w", used + index) for index in range(2**qubits))
            operations.append(Amplitudes(tuple(range(first, first + qubits)), values, ()))
            used += len(values)
        first += qubits
    for gate in unitaries.circuit.gates:
        if gate.name == "Rot" and unitaries.kind != "identity":
            angles = tuple(weight("w", used + index) for index in range(3 if unitaries.is_complex else 1))
            operations.append(Gate("Rot" if unitaries.is_complex else "RY", gate.wires, angles))
            used += len(angles)
        elif gate.name == "RZ" or (gate.name != "Rot" and unitaries.kind != "identity"):
            operations.append(gate)
    own = (Weights("w", (used,)),) if used else ()
    return Circuit("amplitudes", n, tuple(operations), unitaries.circuit.observables, weights=own)


def _modules(head: nn.Module) -> dict[str, QuantumLayer | System]:
    """What a head evaluates as circuits, by place."""
    return {name: module for name, module in head.named_modules() if isinstance(module, QuantumLayer | System)}


def _samples(trained: Trained, model: Model) -> dict[tuple[str, str], int]:
    """Head and place of each circuit -> samples that it gets for `RAYS` training rays."""
    modules = {(name, place): each for name, head in heads_of(model).items() for place, each in _modules(head).items()}
    seen = trained.watched(model, modules, lambda _, out: out.shape[:-1].numel(), RAYS, trained.step)
    return {key: sum(counts) for key, counts in seen.items()}
