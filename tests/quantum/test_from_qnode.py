"""`from_qnode`: QNodes of PennyLane as layers, beside `TorchLayer`, and what they refuse."""

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pennylane as qml
import pytest
import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn.utils import parametrize, prune

from qnerf.quantum import from_qnode
from qnerf.quantum.layer import QuantumLayer
from tests.helpers.templates import TEMPLATES

UNTRACED = {
    "TrotterProduct": "complex",
    "QuantumPhaseEstimation": "complex",
    "SelectPauliRot": "not inexact",
    "HilbertSchmidt": "array",
}
"""Templates whose own decompositions take numbers only, with words of the message."""


@pytest.mark.parametrize("name", TEMPLATES)
def test_templates_of_pennylane_are_the_torch_layers_of_the_same_weights(name: str) -> None:
    template = TEMPLATES[name]

    def bare(inputs: Any) -> Any:
        return weighted(inputs, None)

    def weighted(inputs: Any, w: Any) -> Any:
        template.queue(inputs, w)
        return [qml.expval(qml.Z(0)), qml.expval(qml.X(1) @ qml.Y(0)), qml.expval(qml.Z(template.wires - 1))]

    node = qml.QNode(weighted if template.shape else bare, qml.device("default.qubit", wires=template.wires))
    shapes = {"w": template.shape} if template.shape else {}
    x = torch.rand(template.features or 1, dtype=torch.float64)
    layer = from_qnode(node, shapes).double()
    if name in UNTRACED:
        with pytest.raises(ValueError, match=UNTRACED[name]):
            layer(x)
        return
    peer = qml.qnn.TorchLayer(node, shapes).double()
    peer.load_state_dict(layer.state_dict())
    torch.testing.assert_close(layer(x), peer(x), rtol=0, atol=1e-12)
    used = {weight for operation in layer.circuit(len(x)).operations for a in operation.angles for weight in a.weights}
    assert len(used) == sum(value.numel() for value in layer.parameters())


def test_the_page_lists_the_templates() -> None:
    page = (Path(__file__).parents[2] / "docs" / "quantum.md").read_text()
    for name in TEMPLATES:
        assert (f"`{name}`" in page.split("On the device alone")[0]) == (name not in UNTRACED), name


def test_from_qnode_has_the_shapes_of_torch_layer() -> None:
    def listed(inputs: Any, w: Any) -> Any:
        qml.AngleEmbedding(inputs[..., :2], wires=range(2))
        qml.RX(w * inputs[..., 2], wires=0)
        return [qml.expval(qml.Z(0)), qml.probs(wires=1)]

    def together(inputs: Any, w: Any) -> Any:
        qml.RX(w * inputs[:, 1] ** 2, wires=0)  # a batch, as TorchLayer passes
        return qml.expval(qml.Z(0)), qml.var(qml.X(0))

    for function in (listed, together):
        node = qml.QNode(function, qml.device("default.qubit", wires=2))
        layer, peer = from_qnode(node, {"w": ()}), qml.qnn.TorchLayer(node, {"w": ()})
        peer.load_state_dict(layer.state_dict())
        for shape in ((4, 3), (2, 5, 3)):
            x = torch.rand(*shape)
            torch.testing.assert_close(layer(x), peer(x), rtol=0, atol=1e-6)
        layer(x).sum().backward()
        assert layer.w.grad is not None


@pytest.mark.parametrize(
    ("operation", "message"),
    [
        (lambda x: qml.RX(torch.sin(x[0]), wires=0), "cannot be traced: sin"),
        (lambda x: qml.RX(1 / x[0], wires=0), "cannot be traced: unsupported operand"),
        (lambda x: qml.measure(0), "MidMeasureMP is no gate; qml.defer_measurements"),
        (lambda x: qml.BitFlip(0.1, wires=0), "BitFlip is no gate; noise is an argument of QuantumLayer"),
        (lambda x: qml.AmplitudeEmbedding(x, wires=0, pad_with=0.0), "a state of 1 wires has 2 amplitudes, got 3"),
        (lambda x: qml.AngleEmbedding(x, wires=[0]), "Features must be of length 1 or less; got length 3.$"),
    ],
)
def test_from_qnode_names_what_it_cannot_take(operation: Callable[[Any], Any], message: str) -> None:
    def function(inputs: Any) -> Any:
        operation(inputs)
        return qml.expval(qml.Z(0))

    device = qml.device("default.qubit", wires=1)
    with pytest.raises(ValueError, match=message) as error:
        from_qnode(qml.QNode(function, device), {})(torch.rand(4, 3))
    assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match="got a QNode with shots=10"):
        from_qnode(qml.set_shots(qml.QNode(function, device), 10), {})


@pytest.mark.parametrize(
    ("function", "shapes", "message"),
    [
        (
            lambda params: qml.expval(qml.Z(0)),
            {"params": 2},
            'a circuit without data runs on qml.device\\("qnerf.fast"',
        ),
        (lambda inputs, w, v: qml.expval(qml.Z(0)), {"w": 2}, "for the parameters w, v, misses v"),
        (lambda inputs, w: qml.expval(qml.Z(0)), {"w": 2, "u": 1}, "for the parameters w, got u"),
        (lambda inputs: None, {}, "returns no measurement; known: expval, var, probs"),
        (lambda inputs: qml.state(), {}, "the measurement State is not computed; known: expval, var, probs"),
    ],
)
def test_from_qnode_says_what_the_function_misses(function: Any, shapes: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        from_qnode(qml.QNode(function, qml.device("default.qubit", wires=1)), shapes)(torch.rand(2, 1))


def rotated() -> Any:
    def node(inputs: Any, w: Any) -> Any:
        qml.AngleEmbedding(inputs, wires=range(2))
        qml.StronglyEntanglingLayers(w, wires=range(2))
        return [qml.expval(qml.Z(0)), qml.expval(qml.X(0) @ qml.X(1))]

    return from_qnode(qml.QNode(node, qml.device("default.qubit", wires=2)), {"w": (2, 2, 3)})


def test_from_qnode_sees_a_parameter_that_was_replaced() -> None:
    """By load_state_dict(assign=True), torch.func, pruning, a parametrisation or an assignment."""
    x, zeros = torch.rand(3, 2), torch.zeros(2, 2, 3)
    layer, expected = rotated(), rotated()
    with torch.no_grad():
        expected.w.zero_()
    assert not torch.allclose(layer(x), expected(x))
    assert torch.equal(functional_call(layer, {"w": zeros}, (x,)), expected(x))
    layer.load_state_dict({"w": zeros}, assign=True)
    assert torch.equal(layer(x), expected(x))
    assert torch.equal(copy.deepcopy(layer)(x), expected(x))
    layer = rotated()
    layer.w = nn.Parameter(zeros)
    assert torch.equal(layer(x), expected(x))
    layer = prune.l1_unstructured(rotated(), "w", amount=12)
    assert torch.equal(layer(x), expected(x))
    layer = rotated()
    parametrize.register_parametrization(layer, "w", Zero())
    assert torch.equal(layer(x), expected(x))


class Zero(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        return 0 * x


@pytest.mark.parametrize("form", [lambda x: qml.X(0) if x[0] else None, lambda x: qml.X(0) if x[0] == 1 else None])
def test_a_circuit_whose_form_depends_on_an_input_is_refused(form: Callable[[Any], Any]) -> None:
    """Traced once, it would have one form for every input."""

    def node(inputs: Any) -> Any:
        form(inputs)
        return qml.expval(qml.Z(0))

    with pytest.raises(ValueError, match="the form of a circuit cannot depend on the value of an input or a weight"):
        from_qnode(qml.QNode(node, qml.device("default.qubit", wires=1)), {})(torch.zeros(2, 1))


def test_a_weight_with_the_name_of_something_else_is_refused() -> None:
    node = qml.QNode(lambda inputs, forward: qml.expval(qml.Z(0)), qml.device("default.qubit", wires=1))
    with pytest.raises(ValueError, match="a weight cannot be called forward, as something of its module is"):
        from_qnode(node, {"forward": 1})


@pytest.mark.parametrize("options", [{}, {"shots": 10}, {"noise": 0.01}, {"noise": 0.01, "shots": 10}])
@pytest.mark.parametrize("circuit", ["any", "re-uploading"])
def test_a_layer_used_under_inference_mode_trains_and_takes_negated_and_empty_batches(
    circuit: str, options: dict[str, Any]
) -> None:
    kind: tuple[Any, ...] = (rotated().circuit(2),) if circuit == "any" else (2, 1)
    layer = QuantumLayer(*kind, **options, seed=0)
    x = torch.rand(3, 2)
    with torch.inference_mode():
        layer(x)
    out = layer(torch._neg_view(-x))
    assert torch.equal(out, layer(x)) or options
    (out * torch.tensor(1j)).imag.sum().backward()
    torch.imag(torch.conj(layer(x) * torch.tensor(1j))).sum().backward()
    assert layer(x[:0]).shape == (0, out.shape[1])


def test_from_qnode_takes_defaults_any_names_and_empty_batches() -> None:
    def function(inputs: Any, depth: int = 2, **weights: Any) -> Any:
        for _ in range(depth):
            qml.RX(inputs[..., 0] + weights["a"], wires=0)
        return [qml.expval(qml.Z(0)), qml.probs(wires=0)]

    layer = from_qnode(qml.QNode(function, qml.device("default.qubit", wires=1)), {"a": ()})
    x = torch.rand(3, 2, requires_grad=True)
    torch.testing.assert_close(layer(x)[:, 0], (2 * (x[:, 0] + layer.a)).cos())
    assert layer(x[:0]).shape == (0, 3)
    assert layer(x[None, :0]).shape == (1, 0, 3)
    assert copy.deepcopy(layer)(x).shape == (3, 3)
    compiled = torch.compile(layer, backend="aot_eager")
    torch.testing.assert_close(compiled(x.detach()), layer(x))
    for wrong, kind in ((x.int(), "a tensor of torch.int32"), (np.zeros((2, 2)), "ndarray")):
        with pytest.raises(ValueError, match=f"floating-point tensor .*, got {kind}"):
            layer(wrong)
    with pytest.raises(ValueError, match="expects a QNode, as"):
        from_qnode(function, {})
