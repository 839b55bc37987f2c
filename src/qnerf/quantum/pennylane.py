"""The circuit on PennyLane: the reference of the engines, and the way to other devices, their shots and their noise.

It is built from the circuit's description gate by gate, and shares nothing with the engines that it checks. PennyLane
is imported on first use: `import qnerf` stays quick.
"""

from collections.abc import Callable
from typing import Any, Literal, Protocol, runtime_checkable

import torch
from torch import Tensor

from qnerf.config.bounds import PositiveInt, Seed, checked
from qnerf.quantum.circuit import Circuit, Encoding, Entangler, Rotations
from qnerf.quantum.noise import Noise

DiffMethod = Literal["backprop", "parameter-shift", "adjoint"]


@runtime_checkable
class Device(Protocol):
    """A PennyLane device, without importing PennyLane."""

    @property
    def name(self) -> str: ...

    @property
    def wires(self) -> Any: ...


def check_shots(shots: int | None) -> None:
    """ValueError unless `shots` is a positive integer or None."""
    if shots is not None and (isinstance(shots, bool) or not isinstance(shots, int) or shots < 1):
        raise ValueError(f"shots expects a positive integer or None, got {shots!r}")


def apply(circuit: Circuit, x: Any, weights: Any, noise: Noise | None = None) -> None:
    """Queues the circuit's gates inside a QNode, for x (n,) or (B, n) and weights (rows, n, 3)."""
    import pennylane as qml

    def add_noise(*wires: int) -> None:
        for wire in wires:
            for name, probability in noise.after(len(wires)) if noise is not None else ():
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


def observables(circuit: Circuit) -> list[Any]:
    """The circuit's Pauli words as PennyLane observables."""
    import pennylane as qml

    def letter(wire: int, name: str) -> Any:
        return getattr(qml, f"Pauli{name}")(wire)

    words = [[letter(wire, name) for wire, name in word] for word in circuit.observables]
    return [qml.prod(*word) if len(word) > 1 else word[0] if word else qml.Identity(0) for word in words]


def _quantum_function(circuit: Circuit, noise: Noise | None) -> Callable[[Any, Any], list[Any]]:
    import pennylane as qml

    def quantum_function(x: Any, weights: Any) -> list[Any]:
        apply(circuit, x, weights, noise)
        return [qml.expval(observable) for observable in observables(circuit)]

    return quantum_function


def make_device(device: str | Device, wires: int, seed: int | None = None, options: dict | None = None) -> Any:
    """A PennyLane device by its name with its own options, or the device itself.

    Raises:
        ValueError: an unknown name (the message lists the installed ones), options that the device refuses, or a device
            that is given as an object with options, a seed or other wires.
    """
    import pennylane as qml

    if not isinstance(device, str):
        if options or seed is not None:
            raise ValueError(f"device {device.name} is given as an object; give it its options and its seed there")
        if device.wires and len(device.wires) < wires:
            raise ValueError(f"device {device.name} has {len(device.wires)} wires, the circuit needs {wires}")
        return device
    name = device
    try:
        return qml.device(name, wires=wires, **(options or {}), **({} if seed is None else {"seed": seed}))
    except Exception as error:
        known = ", ".join(sorted(qml.plugin_devices))
        first = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(f"device: PennyLane cannot make {name!r} ({first}); installed: {known}") from None


@checked
def make_node(
    circuit: Circuit,
    *,
    device: str | Device = "default.qubit",
    device_options: dict | None = None,
    diff_method: DiffMethod = "backprop",
    shots: PositiveInt | None = None,
    noise: Noise | None = None,
    seed: Seed | None = None,
) -> Callable[[Tensor, Tensor], Tensor]:
    """A function of x (B, n) in radians and weights (rows, n, 3) that returns expectation values (B, outputs).

    Args:
        circuit: what is run.
        device: any PennyLane device, by its name or as an object. Noise needs one that takes channels, such as
            default.mixed.
        device_options: of a device given by its name, such as {"readout_prob": 0.02} of default.mixed.
        diff_method: backprop, parameter-shift (the only one with shots) or adjoint.
        shots: of each circuit; None for exact expectation values.
        noise: channels after every gate; without errors of the readout, which are an option of the device.
        seed: of the device's shots.

    Raises:
        ValueError: an unknown device or `diff_method`, or options that do not go together.
    """
    import pennylane as qml

    if shots is not None and diff_method != "parameter-shift":
        raise ValueError(f"shots={shots} expects diff_method=parameter-shift, got {diff_method!r}")
    target = make_device(device, circuit.wires, seed, device_options)
    if noise is not None and noise.readout_factors != (1.0, 0.0):
        raise ValueError("noise: readout expects another method than pennylane; there it is an option of the device")
    if noise is not None and noise.gates:
        _check_channels(target)
    # Only backprop without channels can broadcast over the batch.
    broadcast = diff_method == "backprop" and (noise is None or not noise.gates)

    node = qml.QNode(_quantum_function(circuit, noise), target, interface="torch", diff_method=diff_method)
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

    weights = torch.zeros(circuit.rows, circuit.wires, 3)
    node = qml.QNode(_quantum_function(circuit, None), qml.device("default.qubit", wires=circuit.wires))
    return str(qml.draw(node, decimals=None, max_length=200)(torch.zeros(circuit.wires), weights))
