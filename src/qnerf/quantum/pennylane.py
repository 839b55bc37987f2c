"""The circuit on PennyLane: the reference of the engines, and the way to other devices, their shots and their noise.

It is built from the circuit's description gate by gate, and shares nothing with the engines that it checks. PennyLane
is imported on first use: `import qnerf` stays quick.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import prod
from typing import Any, Literal

import torch
from torch import Tensor

from qnerf.config.bounds import PositiveInt, Seed, checked
from qnerf.quantum.circuit import (
    Amplitudes,
    Circuit,
    Encoding,
    Entangler,
    Expression,
    Hamiltonian,
    Observable,
    PauliWord,
    Probabilities,
    Rotations,
)
from qnerf.quantum.expression_table import offsets
from qnerf.quantum.pauli_form import as_gates

DiffMethod = Literal["backprop", "parameter-shift", "adjoint"]

CHANNELS = {
    "depolarizing": "DepolarizingChannel",
    "amplitude_damping": "AmplitudeDamping",
    "phase_damping": "PhaseDamping",
    "bit_flip": "BitFlip",
}
"""Field of `Noise` -> PennyLane's channel, in the order in which they follow a gate."""


@dataclass(frozen=True)
class Noise:
    """Channels after every gate, on each wire that the gate touches; probabilities in [0, 1].

    >>> Noise(depolarizing=0.01, bit_flip=0.002).channels
    [('DepolarizingChannel', 0.01), ('BitFlip', 0.002)]

    Raises:
        ValueError: a value that is no probability.
    """

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
        return bool(self.channels)

    @property
    def channels(self) -> list[tuple[str, float]]:
        """PennyLane's name and the probability of each channel that is not 0."""
        return [(channel, vars(self)[name]) for name, channel in CHANNELS.items() if vars(self)[name]]

    def kraus_operators(self) -> list[list[Tensor]]:
        """For each channel its Kraus operators (2, 2), complex128."""
        import pennylane as qml

        return [
            [torch.from_numpy(k).to(torch.complex128) for k in getattr(qml, name).compute_kraus_matrices(p)]
            for name, p in self.channels
        ]


def check_shots(shots: int | None) -> None:
    """ValueError unless `shots` is a positive integer or None."""
    if shots is not None and (isinstance(shots, bool) or not isinstance(shots, int) or shots < 1):
        raise ValueError(f"shots expects a positive integer or None, got {shots!r}")


def apply(circuit: Circuit, x: Any, weights: Any, noise: Noise | None = None) -> None:
    """Queues the circuit's gates inside a QNode, for x (features,) or (B, features).

    The weights are (rows, n, 3) for a re-uploading circuit, and flat for any other.
    """
    import pennylane as qml

    if not circuit.reuploading:
        _apply_gates(circuit, x, weights, noise)
        return

    def add_noise(*wires: int) -> None:
        for wire in wires:
            for name, probability in noise.channels if noise is not None else ():
                getattr(qml, name)(probability, wires=wire)

    for operation in circuit.operations:
        if isinstance(operation, Rotations):
            for wire in range(circuit.wires):
                phi, theta, omega = (weights[operation.row, wire, k] for k in range(3))
                qml.Rot(phi, theta, omega, wires=wire)
                add_noise(wire)
        elif isinstance(operation, Entangler):
            for pair in operation.pairs:
                getattr(qml, operation.gate)(wires=pair)
                add_noise(*pair)
        else:
            assert isinstance(operation, Encoding)
            gate = getattr(qml, f"R{operation.axis}")
            for wire in range(circuit.wires):
                gate(operation.scales[wire] * x[..., wire], wires=wire)
                add_noise(wire)


def _apply_gates(circuit: Circuit, x: Any, weights: Any, noise: Noise | None) -> None:
    """`apply` gate by gate, for flat weights."""
    import pennylane as qml

    first = offsets(circuit.parameters)

    def value(expression: Expression | float) -> Any:
        total = weights.new_zeros(())
        for coefficient, names, features in Expression.of(expression).terms:
            factors = [weights[first[name] + index] for name, index in names] + [x[..., index] for index in features]
            total = total + prod(factors, start=coefficient)
        return total

    for operation in circuit.operations:
        if isinstance(operation, Amplitudes):
            parts = [torch.stack(torch.broadcast_tensors(*(torch.as_tensor(value(a)) for a in part)), -1) + 0j
                     for part in (operation.real, operation.imaginary) if part]  # fmt: skip
            state = parts[0] + (1j * parts[1] if len(parts) > 1 else 0)
            norm = state.abs().square().sum(-1, keepdim=True).sqrt()
            qml.StatePrep(state / norm, wires=operation.wires, validate_norm=False)
        for gate in as_gates(operation, circuit):
            words = (gate.word,) if gate.word else ()
            getattr(qml, gate.name)(*map(value, gate.angles), *words, wires=gate.wires)
            for wire in gate.wires:
                for name, probability in noise.channels if noise is not None else ():
                    getattr(qml, name)(probability, wires=wire)


def _product(word: PauliWord) -> Any:
    import pennylane as qml

    letters = [getattr(qml, f"Pauli{name}")(wire) for wire, name in word]
    return qml.prod(*letters) if len(letters) > 1 else letters[0] if letters else qml.Identity(0)


def observables(circuit: Circuit) -> list[Any]:
    """The circuit's Pauli words as PennyLane observables."""
    return [_product(word) for word in circuit.words]


def measurements(circuit: Circuit) -> list[Any]:
    """What the circuit measures, as PennyLane's measurements."""
    import pennylane as qml

    def measurement(observable: Observable) -> Any:
        if isinstance(observable, Probabilities):
            return qml.probs(wires=observable.wires)
        if isinstance(observable, Hamiltonian):
            return qml.expval(qml.dot(observable.coefficients, [_product(word) for word in observable.words]))
        return qml.expval(_product(observable))

    return [measurement(observable) for observable in circuit.observables]


def _quantum_function(circuit: Circuit, noise: Noise | None) -> Callable[[Any, Any], list[Any]]:
    def quantum_function(x: Any, weights: Any) -> list[Any]:
        apply(circuit, x, weights, noise)
        return measurements(circuit)

    return quantum_function


def make_device(name: str, wires: int, seed: int | None = None) -> Any:
    """A PennyLane device by its name. The ValueError for an unknown one lists those that are installed."""
    import pennylane as qml

    try:
        return qml.device(name, wires=wires) if seed is None else qml.device(name, wires=wires, seed=seed)
    except Exception as error:
        known = ", ".join(sorted(qml.plugin_devices))
        first = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(f"device: PennyLane cannot make {name!r} ({first}); installed: {known}") from None


@checked
def make_node(
    circuit: Circuit,
    *,
    device: str = "default.qubit",
    diff_method: DiffMethod = "backprop",
    shots: PositiveInt | None = None,
    noise: Noise | None = None,
    seed: Seed | None = None,
) -> Callable[[Tensor, Tensor], Tensor]:
    """A function of x (B, features) in radians and weights, see `apply`, that returns (B, outputs).

    Args:
        circuit: what is run.
        device: any PennyLane device. Noise needs one that takes channels, such as default.mixed.
        diff_method: backprop, parameter-shift (the only one with shots) or adjoint.
        shots: of each circuit; None for exact expectation values.
        noise: channels after every gate.
        seed: of the device's shots.

    Raises:
        ValueError: an unknown device or `diff_method`, or options that do not go together.
    """
    import pennylane as qml

    if shots is not None and diff_method != "parameter-shift":
        raise ValueError(f"shots={shots} expects diff_method=parameter-shift, got {diff_method!r}")
    target = make_device(device, circuit.wires, seed)
    if noise is not None and noise.any:
        _check_channels(target)
    # Only backprop without channels can broadcast over the batch.
    broadcast = diff_method == "backprop" and (noise is None or not noise.any)

    node = qml.QNode(_quantum_function(circuit, noise), target, interface="torch", diff_method=diff_method)
    if shots is not None:
        node = qml.set_shots(node, shots)

    sizes = [2 ** len(o.wires) if isinstance(o, Probabilities) else 1 for o in circuit.observables]

    def run(x: Tensor, weights: Tensor) -> Tensor:
        if x.shape[0] == 0:
            return x.new_zeros(0, circuit.outputs) + 0 * weights.sum()
        if broadcast:
            values = zip(node(x, weights), sizes, strict=True)
            return torch.cat([value.reshape(-1, size).expand(len(x), size) for value, size in values], -1).to(x.dtype)
        return torch.stack([torch.cat([value.flatten() for value in node(sample, weights)]) for sample in x]).to(
            x.dtype
        )

    return run


def _check_channels(device: Any) -> None:
    """ValueError unless the device takes channels."""
    import pennylane as qml

    @qml.qnode(device)
    def one_channel() -> Any:
        qml.DepolarizingChannel(0.1, wires=0)
        return qml.expval(qml.PauliZ(0))

    try:
        one_channel()
    except Exception as error:
        raise ValueError(
            f"noise: device {device.name} takes no channels; choose one that does, such as default.mixed"
        ) from error


def draw(circuit: Circuit) -> str:
    """The circuit as `qml.draw` shows it, without angles.

    >>> from qnerf.quantum.circuit import ANSATZE
    >>> print(draw(ANSATZE.build("rx", 2, 1)))
    0: ──Rot─╭●─╭Z──Rot─╭●─╭Z──RX──Rot─╭●─╭Z──Rot─╭●─╭Z─┤  <Z>
    1: ──Rot─╰Z─╰●──Rot─╰Z─╰●──RX──Rot─╰Z─╰●──Rot─╰Z─╰●─┤  <Z>
    """
    import pennylane as qml

    shape = (circuit.rows, circuit.wires, 3) if circuit.reuploading else (sum(map(prod, circuit.parameters.values())),)
    node = qml.QNode(_quantum_function(circuit, None), qml.device("default.qubit", wires=circuit.wires))
    return str(qml.draw(node, decimals=None, max_length=200)(torch.ones(circuit.features or 0), torch.zeros(shape)))
