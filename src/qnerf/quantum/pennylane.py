"""The circuit on PennyLane: the reference of the engines, and the way to other devices, their shots and their noise.

It is built from the circuit's description gate by gate, and shares nothing with the engines that it checks. PennyLane
is imported on first use: `import qnerf` stays quick.
"""

from collections.abc import Callable
from math import prod
from typing import Any, Literal, Protocol, runtime_checkable

import torch
from torch import Tensor

from qnerf.config.bounds import PositiveInt, Seed, checked
from qnerf.quantum.circuit import (
    Amplitudes,
    Circuit,
    Expression,
    Hamiltonian,
    Observable,
    PauliWord,
    Probabilities,
)
from qnerf.quantum.expression_table import offsets
from qnerf.quantum.noise import Noise
from qnerf.quantum.pauli_form import as_gates

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
    """Queues the circuit's gates inside a QNode, for x (features,) or (B, features) and flat weights."""
    import pennylane as qml

    first = offsets(circuit.parameters)
    zero = weights[:0].sum()  # of the kind of the weights, a tensor or an array

    def value(expression: Expression | float) -> Any:
        total = zero
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
                for name, probability in noise.after(len(gate.wires)) if noise is not None else ():
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
    """A function of x (B, features) in radians and flat weights that returns (B, outputs).

    Args:
        circuit: what is run.
        device: any PennyLane device, by its name or as an object. Noise needs one that takes channels, such as
            default.mixed.
        device_options: of a device given by its name, such as {"readout_prob": 0.02} of default.mixed.
        diff_method: backprop, parameter-shift (the only one with shots) or adjoint.
        shots: of each circuit; None for exact expectation values.
        noise: channels after every gate, which PennyLane refuses at the first call on a device without them; errors of
            the readout are an option of the device instead.
        seed: of the device's shots.

    Raises:
        ValueError: an unknown device or `diff_method`, or options that do not go together.
    """
    import pennylane as qml

    if shots is not None and diff_method != "parameter-shift":
        raise ValueError(f"shots={shots} expects diff_method=parameter-shift, got {diff_method!r}")
    target = make_device(device, circuit.wires, seed, device_options)
    if noise is not None and noise.readout:
        raise ValueError("noise: readout expects another method than pennylane; there it is an option of the device")
    # Only backprop without channels can broadcast over the batch.
    broadcast = diff_method == "backprop" and (noise is None or not noise.gates)

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


def draw(circuit: Circuit | Any) -> str:
    """A circuit or the circuit of a layer, as `qml.draw` shows it, without angles.

    >>> from qnerf.quantum.circuit import ANSATZE
    >>> print(draw(ANSATZE.build("rx", 2, 1)))
    0: ──Rot─╭●─╭Z──Rot─╭●─╭Z──RX──Rot─╭●─╭Z──Rot─╭●─╭Z─┤  <Z>
    1: ──Rot─╰Z─╰●──Rot─╰Z─╰●──RX──Rot─╰Z─╰●──Rot─╰Z─╰●─┤  <Z>
    """
    import pennylane as qml

    circuit = circuit if isinstance(circuit, Circuit) else circuit.circuit
    node = qml.QNode(_quantum_function(circuit, None), qml.device("default.qubit", wires=circuit.wires))
    return str(
        qml.draw(node, decimals=None, max_length=200)(torch.ones(circuit.features or 0), torch.zeros(circuit.size))
    )
