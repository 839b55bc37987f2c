"""The circuit on PennyLane: the reference of the other engines, and the way to shots, noise and hardware.

Built from the description alone, gate by gate, so that it shares nothing with the engines it checks.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from qnerf.quantum.circuit import Circuit, Encoding, Entangler, Rotations

DIFF_METHODS = ("backprop", "parameter-shift", "adjoint")


@dataclass(frozen=True)
class Noise:
    """Channels behind every gate, on each wire that it touches; probabilities in [0, 1]."""

    depolarizing: float = 0.0
    amplitude_damping: float = 0.0
    phase_damping: float = 0.0
    bit_flip: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not isinstance(value, (int, float)) or isinstance(value, bool) or not 0 <= value <= 1:
                raise ValueError(f"noise: {name} expects a probability in [0, 1], got {value!r}")

    @property
    def any(self) -> bool:
        return any(vars(self).values())


def apply(circuit: Circuit, x: Any, weights: Any, noise: Noise | None = None) -> None:
    """Queues the circuit's gates. x (n,) or (B, n); weights (rows, n, 3)."""
    import pennylane as qml

    def channels(*wires: int) -> None:
        if noise is None:
            return
        for wire in wires:
            if noise.depolarizing:
                qml.DepolarizingChannel(noise.depolarizing, wires=wire)
            if noise.amplitude_damping:
                qml.AmplitudeDamping(noise.amplitude_damping, wires=wire)
            if noise.phase_damping:
                qml.PhaseDamping(noise.phase_damping, wires=wire)
            if noise.bit_flip:
                qml.BitFlip(noise.bit_flip, wires=wire)

    for operation in circuit.operations:
        if isinstance(operation, Rotations):
            for wire in range(circuit.wires):
                phi, theta, omega = (weights[operation.row, wire, k] for k in range(3))
                qml.Rot(phi, theta, omega, wires=wire)
                channels(wire)
        elif isinstance(operation, Entangler):
            for pair in operation.pairs:
                getattr(qml, operation.gate)(wires=pair)
                channels(*pair)
        else:
            assert isinstance(operation, Encoding)
            gate = getattr(qml, f"R{operation.axis}")
            for wire in range(circuit.wires):
                gate(operation.scales[wire] * x[..., wire], wires=wire)
                channels(wire)


def observables(circuit: Circuit) -> list[Any]:
    """PennyLane's observables of the circuit's words."""
    import pennylane as qml

    def letter(wire: int, name: str) -> Any:
        return getattr(qml, f"Pauli{name}")(wire)

    words = [[letter(wire, name) for wire, name in word] for word in circuit.observables]
    return [qml.prod(*word) if len(word) > 1 else word[0] if word else qml.Identity(0) for word in words]


def make_device(name: str, wires: int, seed: int | None = None) -> Any:
    """A PennyLane device by name; ValueError lists the installed ones."""
    import pennylane as qml

    try:
        return qml.device(name, wires=wires) if seed is None else qml.device(name, wires=wires, seed=seed)
    except Exception as error:
        known = ", ".join(sorted(qml.plugin_devices))
        first = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(f"device: PennyLane cannot make {name!r} ({first}); installed: {known}") from None


def make_node(
    circuit: Circuit,
    *,
    device: str = "default.qubit",
    diff_method: str = "backprop",
    shots: int | None = None,
    noise: Noise | None = None,
    seed: int | None = None,
) -> Callable[[Tensor, Tensor], Tensor]:
    """A function of x (B, n) and weights (rows, n, 3) that returns (B, outputs).

    device       any PennyLane device; noise needs one that takes channels, such as default.mixed
    diff_method  backprop, parameter-shift (the only one with shots) or adjoint
    shots        None: exact expectation values
    """
    import pennylane as qml

    if diff_method not in DIFF_METHODS:
        raise ValueError(f"diff_method: unknown name {diff_method!r}; known: {', '.join(DIFF_METHODS)}")
    if shots is not None and (isinstance(shots, bool) or not isinstance(shots, int) or shots < 1):
        raise ValueError(f"shots expects a positive integer or None, got {shots!r}")
    if shots is not None and diff_method != "parameter-shift":
        raise ValueError(f"shots={shots} expects diff_method=parameter-shift, got {diff_method!r}")
    target = make_device(device, circuit.wires, seed)
    # Broadcasting of the batch is left out where gradients or channels do not know it.
    broadcast = diff_method == "backprop" and (noise is None or not noise.any)

    def quantum_function(x: Any, weights: Any) -> Any:
        apply(circuit, x, weights, noise)
        return [qml.expval(observable) for observable in observables(circuit)]

    node = qml.QNode(quantum_function, target, interface="torch", diff_method=diff_method)
    if shots is not None:
        node = qml.set_shots(node, shots)

    def run(x: Tensor, weights: Tensor) -> Tensor:
        if x.shape[0] == 0:
            return x.new_zeros(0, len(circuit.observables)) + 0 * weights.sum()
        if broadcast:
            values = [value.expand(x.shape[0]) if value.ndim == 0 else value for value in node(x, weights)]
            return torch.stack(values, -1).to(x.dtype)
        return torch.stack([torch.stack(list(node(sample, weights))) for sample in x]).to(x.dtype)

    return run


def draw(circuit: Circuit) -> str:
    """`qml.draw` of the circuit, with x0, x1, ... for the inputs."""
    import pennylane as qml

    weights = torch.zeros(circuit.rows, circuit.wires, 3)
    device = qml.device("default.qubit", wires=circuit.wires)

    def quantum_function(x: Any) -> Any:
        apply(circuit, x, weights)
        return [qml.expval(observable) for observable in observables(circuit)]

    node = qml.QNode(quantum_function, device)
    return str(qml.draw(node, decimals=None, max_length=200)(torch.zeros(circuit.wires)))
