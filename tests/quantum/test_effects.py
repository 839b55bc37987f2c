"""What has no effect is said, and only that: each line against derivatives of random inputs and weights."""

import warnings
from dataclasses import replace

import pennylane as qml
import pytest
import torch

from qnerf.quantum import QuantumLayer, from_qnode
from qnerf.quantum.circuit import ANSATZE, Amplitudes, Circuit, Gate, Hamiltonian, Probabilities, Weights, feature
from qnerf.quantum.effects import without_effect
from tests.helpers.circuits import FEATURES, random_circuit

W = Weights("w", (2,))
X, TURN = Gate("RX", 0, feature(0)), Gate("RY", 0, W[0])
AXES = "x[0] commute with every trainable gate; a rotation about another axis would not"
Z0 = ((0, "Z"),)

CASES = {
    "a phase of |0...0>": ([Gate("RZ", 0, W[1]), X, TURN], [Z0], 1, ["no output depends on w[1]"]),
    "a phase before Z": ([X, TURN, Gate("CRZ", (0, 1), W[1])], [Z0], 1, ["no output depends on w[1]"]),
    "outside the light cone": ([X, TURN, Gate("RY", 1, W[1])], [Z0], 1, ["no output depends on w[1]"]),
    "a start outside the light cone": (
        [Amplitudes(1, (W[1], 1.0)), X, TURN], [Z0], 1, ["no output depends on w[1]"],
    ),
    "a weight that no gate takes": ([X, TURN], [Z0], 1, ["no output depends on w[1]"]),
    "a feature that no gate takes": ([X, TURN, Gate("RY", 0, W[1])], [Z0], 2, ["no output depends on x[1]"]),
    "a feature as a phase": (
        [Gate("RZ", 0, feature(1)), X, TURN, Gate("RY", 0, W[1])], [Z0], 2, ["no output depends on x[1]"],
    ),
    "a constant output": ([X, TURN, Gate("RX", 0, W[1])], [Z0, ((1, "Z"),)], 1, ["output 1 is constant"]),
    "the identity": (
        [X, TURN, Gate("RX", 0, W[1])], [Hamiltonian((2.0,), ((),)), Z0], 1, ["output 0 is constant"],
    ),
    "probabilities of idle wires": (
        [X, TURN, Gate("RX", 0, W[1])], [Z0, Probabilities(1)], 1, ["outputs 1, 2 are constant"],
    ),
    "outputs of weights alone": (
        [X, TURN, Gate("RY", 1, W[1])], [Z0, ((1, "Z"),)], 1, ["output 1 is the same for every input"],
    ),
    "one axis": ([X, Gate("RX", 0, W[0]), Gate("RX", 1, W[1])], [Z0, ((1, "Z"),)], 1,
                 ["output 1 is the same for every input", f"all rotations by {AXES}"]),
    "one axis behind CNOTs": (
        [X, Gate("RX", 1, W[0]), Gate("CNOT", (0, 1)), Gate("RX", 0, W[1])], [Z0, ((1, "Z"),)], 1,
        [f"all rotations by {AXES}"],
    ),
    "one axis behind H": (
        [X, Gate("H", 0), Gate("RZ", 0, W[0] + feature(0)), Gate("H", 0), Gate("RX", 0, W[1])], [Z0], 1,
        [f"all rotations by {AXES}"],
    ),
    "a frequency that trains": ([Gate("RX", 0, W[0] * feature(0)), Gate("RX", 0, W[1])], [Z0], 1, []),
    "a gate between that is no Clifford gate": (
        [X, Gate("RY", 0, 0.3), Gate("RX", 0, W[0]), Gate("RX", 0, W[1])], [Z0], 1, [],
    ),
    "all is well": ([X, TURN, Gate("CNOT", (0, 1)), Gate("RX", 0, W[1])], [Z0], 1, []),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_without_effect_says_each_mistake_in_one_line(name):
    operations, observables, features, lines = CASES[name]
    circuit = Circuit("mine", 2, operations, observables, features, W)
    assert list(without_effect(circuit)) == lines
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        QuantumLayer(circuit)
    assert [str(own.message) for own in caught] == [f"circuit mine: {line}" for line in lines]
    assert all(own.filename == __file__ for own in caught)


def test_without_effect_is_true_of_random_circuits():
    for number in range(100):
        circuit = random_circuit(number)
        layer = QuantumLayer(circuit).double()
        x = torch.randn(3, FEATURES, dtype=torch.float64, requires_grad=True)
        y = layer(x)
        to_weights, to_inputs = torch.autograd.grad(y.sum(), (layer.w, x))
        said = " ".join(without_effect(circuit))
        for name, gradient in (("w[0, 0]", to_weights[0, 0]), ("w[1, 0]", to_weights[1, 0]), ("x[1]", to_inputs[:, 1])):
            assert not gradient.any() or f"depends on {name}" not in said, number
        for k in range(circuit.outputs):
            assert f"output {k} is" not in said or (y[:, k] - y[0, k]).abs().max() < 1e-14, number


def test_weights_of_a_named_circuit_are_known():
    qiren = ANSATZE.build("qiren", 4, 2)
    for make in (lambda: QuantumLayer(4, 2), lambda: QuantumLayer(qiren)):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            make()
    with pytest.warns(UserWarning, match=r"circuit own: no output depends on weights1\[0, 0, 0, 0\], .* 3 more"):
        QuantumLayer(replace(qiren, name="own"))


def test_from_qnode_warns_at_the_first_call():
    def mine(inputs, w):
        qml.AngleEmbedding(inputs, wires=range(2))
        qml.BasicEntanglerLayers(w, wires=range(2))
        return [qml.expval(qml.Z(0)), qml.expval(qml.Z(1))]

    layer = from_qnode(qml.QNode(mine, qml.device("default.qubit", wires=2)), {"w": (2, 2)})
    expected = r"circuit mine: all rotations by x\[0\], x\[1\] commute with every trainable gate"
    with pytest.warns(UserWarning, match=expected) as caught:
        layer(torch.rand(3, 2))
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        layer(torch.rand(3, 2))
