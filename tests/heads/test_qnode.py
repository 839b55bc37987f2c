"""A QNode as a head: its values, its options and the names of own circuits."""

import pennylane as qml
import pytest
import torch

from qnerf.heads import HEADS, QirenHead, qnode_head
from qnerf.quantum.circuit import ANSATZE


def own(*, wires: int = 2, layers: int = 1):
    @qml.qnode(qml.device("default.qubit", wires=wires))
    def circuit(inputs, w):
        for layer in range(layers):
            for wire in range(wires):
                qml.RX(inputs[..., wire] + w[layer, wire], wires=wire)
        return [qml.expval(qml.Z(wire)) for wire in range(wires)]

    return circuit, {"w": (layers, wires)}, wires


@pytest.fixture
def head(monkeypatch):
    monkeypatch.setattr(HEADS, "_components", dict(HEADS._components))
    return qnode_head(own)


def test_the_head_is_the_circuit_between_normalisation_and_gain(head):
    built = HEADS.build("own", 5, 3, layers=2, gain=4.0, input_scale=0.5).double()
    features = torch.randn(7, 5, dtype=torch.float64)
    layer = built.hybrid
    angles = 0.5 * torch.nn.functional.batch_norm(layer.linear(features), None, None, training=True)
    values = torch.cos(2 * angles + layer.circuit.w.sum(0))
    assert torch.allclose(built(features), 4 * values @ built.readout.weight.T + built.readout.bias)


def test_its_options_are_the_function_s_and_name_it(head):
    options = HEADS.options("own")
    assert list(options) == ["wires", "layers", "init", "input_scale", "gain"]
    defaults = {key: parameter.default for key, parameter in options.items()}
    assert head.label(defaults) == "own"
    assert head.label(defaults | {"layers": 3, "gain": 2.5}) == "own-layers3-gain2.5"
    with pytest.raises(ValueError, match=r"head=own: unknown option depth=1; known: wires, layers, init"):
        HEADS.build("own", 5, 3, depth=1)


def test_a_function_with_positional_parameters_is_refused():
    with pytest.raises(ValueError, match=r"qnode_head: expected keyword-only parameters, such as .*\(\*, wires"):
        qnode_head(lambda wires: None)


def test_an_ansatz_of_the_user_s_is_named(monkeypatch):
    monkeypatch.setattr(ANSATZE, "_components", dict(ANSATZE._components))
    options = {key: parameter.default for key, parameter in HEADS.options("qiren").items()}
    ANSATZE.register("star")(lambda wires, spectral: None)
    assert QirenHead.label(options) == QirenHead.label(options | {"ansatz": "cnot"}) == "1L2S"
    assert QirenHead.label(options | {"ansatz": "star"}) == "star-1L2S"
