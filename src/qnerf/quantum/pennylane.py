"""The circuit on PennyLane: the reference of the engines, and the way to other devices.

It is built from the circuit's description gate by gate, and shares nothing with the engines that it checks. PennyLane
is imported on first use: `import qnerf` stays quick.
"""

from collections.abc import Callable
from math import prod
from typing import Any

import torch
from torch import Tensor

from qnerf.quantum.angles import offsets
from qnerf.quantum.circuit import (
    Amplitudes,
    Circuit,
    Expression,
    Hamiltonian,
    Observable,
    PauliWord,
    Probabilities,
    values_of,
)
from qnerf.quantum.noise import Noise


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
            continue
        words = (operation.word,) if operation.word else ()
        getattr(qml, operation.name)(*map(value, operation.angles), *words, wires=operation.wires)
        for wire in operation.wires:
            for name, probability in noise.after(len(operation.wires)) if noise is not None else ():
                getattr(qml, name)(probability, wires=wire)


def _product(word: PauliWord) -> Any:
    import pennylane as qml

    letters = [getattr(qml, f"Pauli{name}")(wire) for wire, name in word]
    return qml.prod(*letters) if len(letters) > 1 else letters[0] if letters else qml.Identity(0)


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


def _node(circuit: Circuit) -> Any:
    """The circuit as a QNode of default.qubit, of x and flat weights."""
    import pennylane as qml

    def quantum_function(x: Any, weights: Any) -> list[Any]:
        apply(circuit, x, weights)
        return measurements(circuit)

    device = qml.device("default.qubit", wires=circuit.wires)
    return qml.QNode(quantum_function, device, interface="torch", diff_method="backprop")


def make_node(circuit: Circuit) -> Callable[[Tensor, Tensor], Tensor]:
    """A function of x (B, features) in radians and flat weights that returns (B, outputs): default.qubit, exact."""
    node = _node(circuit)
    sizes = list(map(values_of, circuit.observables))

    def run(x: Tensor, weights: Tensor) -> Tensor:
        if x.shape[0] == 0:
            return x.new_zeros(0, circuit.outputs) + 0 * weights.sum()
        values = zip(node(x, weights), sizes, strict=True)
        return torch.cat([value.reshape(-1, size).expand(len(x), size) for value, size in values], -1).to(x.dtype)

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
    node = qml.draw(_node(circuit), decimals=None, max_length=200)
    return str(node(torch.ones(circuit.features or 0), torch.zeros(circuit.size)))
