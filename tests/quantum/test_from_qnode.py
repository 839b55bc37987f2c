"""`from_qnode`: QNodes of PennyLane as layers, beside `TorchLayer`. Random QNodes are in `test_tapes`."""

import copy
import pickle

import numpy as np
import pennylane as qml
import pytest
import torch
from torch import nn
from torch.func import functional_call
from torch.nn.utils import parametrize, prune

from qnerf.quantum import from_qnode
from qnerf.quantum.layer import QuantumLayer
from tests.helpers.templates import TEMPLATES

ON_DEFAULT_QUBIT = {
    "CommutingEvolution", "PrepSelPrep", "QSVT", "QuantumPhaseEstimation", "Select", "Superposition", "TrotterProduct",
}  # fmt: skip
"""Templates that hold tensors and decompose at numbers only."""
FAIL_IN_PENNYLANE = {"SelectPauliRot", "HilbertSchmidt"}  # with tensors of PyTorch: zeros, and an AttributeError
NO_CIRCUIT = {"AmplitudeEmbedding", "QuantumPhaseEstimation", "Select"} | ON_DEFAULT_QUBIT
"""Templates whose decompositions take numbers only."""


def both(function, shapes, wires=2):
    """`from_qnode` and `TorchLayer`, with the same weights."""
    node = qml.QNode(function, qml.device("default.qubit", wires=wires))
    layer, peer = from_qnode(node, shapes), qml.qnn.TorchLayer(node, shapes)
    peer.load_state_dict(layer.state_dict())
    return layer, peer


def function_of(template):
    def weighted(inputs, w):
        template.queue(inputs, w)
        return [qml.expval(qml.Z(0)), qml.expval(qml.X(1) @ qml.Y(0)), qml.expval(qml.Z(template.wires - 1))]

    return weighted if template.shape else lambda inputs: weighted(inputs, None)


@pytest.mark.filterwarnings("ignore:from_qnode runs")
def test_templates_of_pennylane_are_the_torch_layers_of_the_same_weights():
    for name in TEMPLATES.keys() - FAIL_IN_PENNYLANE:
        template = TEMPLATES[name]
        layer, peer = both(function_of(template), {"w": template.shape} if template.shape else {}, template.wires)
        x = torch.rand(template.features or 1, dtype=torch.float64)
        torch.testing.assert_close(layer.double()(x), peer.double()(x), rtol=0, atol=1e-12, msg=name)
        assert (layer.runs_on == "qnerf") == (name not in ON_DEFAULT_QUBIT), (name, layer.runs_on)
        if name not in NO_CIRCUIT:
            operations = layer.circuit(len(x)).operations
            used = {weight for own in operations for angle in own.angles for weight in angle.weights}
            assert len(used) == sum(value.numel() for value in layer.parameters()), name


def encoded(inputs, weights):
    qml.AngleEmbedding(inputs, wires=range(2))
    qml.StronglyEntanglingLayers(weights, wires=range(2))


@pytest.mark.parametrize("shape", [(4, 2), (2, 3, 2), (1, 2), (2,)])
def test_results_have_the_container_and_the_order_that_are_returned(shape):
    z, x = (lambda: qml.expval(qml.Z(0))), (lambda: qml.var(qml.X(1)))
    returned = {
        "one": z,
        "list of one": lambda: [z()],
        "tuple of one": lambda: (z(),),
        "list": lambda: [z(), qml.probs(wires=[1, 0]), x()],
        "tuple": lambda: (z(), x()),
        "probabilities": lambda: (qml.probs(0), qml.probs(1)),
        "of other sizes": lambda: (qml.probs(0), qml.probs([0, 1])),
        "nested": lambda: [[z()], [x()]],
        "tuple of lists": lambda: ([z(), x()], [z(), z()]),
        "dictionary": lambda: {"z": z()},
        "array": lambda: np.array([z(), x()]),
        "nothing": lambda: None,
        "the second": lambda: (z(), x())[1],
        "another order": lambda: [z(), x()][::-1],
    }
    for name, measure in returned.items():
        layer, peer = both(measuring(measure), {"weights": (3, 2, 3)})
        compare(layer, peer, torch.rand(shape), name)
        assert layer.runs_on == "qnerf"


def compare(layer, peer, x, name):
    """The same values, or the same error."""
    try:
        expected = peer(x)
    except Exception as raised:
        error = raised
    else:
        torch.testing.assert_close(layer(x), expected, msg=name)
        return
    with pytest.raises(type(error)) as own:
        layer(x)
    assert str(own.value) == str(error), name


def test_from_qnode_sees_inputs_weights_and_captured_values_of_each_call():
    held = nn.Parameter(torch.tensor([0.3, 0.7]))
    settings = {"depth": 1, "offset": torch.zeros(2), "scale": np.ones(2)}

    def function(inputs, weights):
        if len(inputs.shape) == 2:
            qml.AngleEmbedding(inputs, wires=range(2))
        if len(inputs) == 3 or inputs.dtype == torch.float64:
            qml.RY(0.4, 1)
        if weights[0] > 0:
            qml.Hadamard(1)
        for layer in range(settings["depth"]):
            qml.RX(torch.sin(inputs[..., 0]) / weights[layer] + settings["offset"][0], wires=0)
            qml.RY(held[1] * settings["scale"][0], wires=1)
        qml.RZ(weights[2] * held[0], wires=0)
        return qml.expval(qml.dot([0.7, -1.6, 0.5], [qml.Z(0), qml.X(0) @ qml.Y(1), qml.I(0)]))

    layer, peer = both(function, {"weights": (3,)})

    def check(x):
        gradients = []
        for own in (layer, peer):
            inputs = x.clone().requires_grad_()
            out = own(inputs)
            own.zero_grad()
            gradients.append([out.detach(), *torch.autograd.grad(out.sum(), (inputs, own.weights, held))])
        for one, two in zip(*gradients, strict=True):
            torch.testing.assert_close(one, two)

    for x in (torch.rand(2), torch.rand(2, 2), torch.rand(3, 2), torch.rand(5, 2, 2), torch.rand(2, 2).double()):
        check(x)
    held.data += 1
    check(x)
    settings["offset"] += 1
    settings["scale"] *= 2
    check(x)
    settings["depth"] = 2
    check(x)
    layer.weights.data.neg_()
    peer.weights.data.neg_()
    check(x)
    assert layer.runs_on == "qnerf"


def measuring(measure):
    def function(inputs, weights):
        encoded(inputs, weights)
        return measure()

    return function


def at_module_level(inputs, weights):
    encoded(inputs, weights)
    return [qml.expval(qml.Z(0)), qml.expval(qml.X(0) @ qml.X(1))]


FREE = qml.device("default.qubit")
NODE = qml.QNode(at_module_level, qml.device("default.qubit", wires=2))


@pytest.mark.filterwarnings("ignore:from_qnode runs")
def test_tools_of_pennylane_take_the_layer_as_they_take_a_torch_layer():
    layer = from_qnode(NODE, {"weights": (3, 2, 3)})
    peer = qml.qnn.TorchLayer(NODE, {"weights": (3, 2, 3)})
    peer.load_state_dict(layer.state_dict())
    x = torch.rand(4, 2)
    tools = [
        lambda own: qml.draw(own)(x),
        lambda own: qml.draw(own.qnode)(x, own.weights),
        lambda own: str(qml.specs(own)(x)["resources"]),
        lambda own: own.construct((x,), {}),
        lambda own: (own.device, own.diff_method, own.interface, str(own), own.qnode.func),
        lambda own: qml.workflow.construct_tape(own)(x).hash,
        lambda own: pickle.loads(pickle.dumps(own))(x).shape,
        lambda own: copy.deepcopy(own)(x).shape,
        lambda own: torch.export.export(own, (x,)).module()(x).tolist(),
        lambda own: [len(axes) for axes in qml.draw_mpl(own)(x)],
    ]
    for tool in tools[:-1]:
        assert tool(layer) == tool(peer)
    counts = []
    for own in (layer, peer):
        with qml.Tracker(own.device) as tracker:
            own(x)
        counts.append(tracker.totals)
    assert counts[0] == counts[1] != {}
    torch.testing.assert_close(pickle.loads(pickle.dumps(layer))(x), peer(x))


@pytest.mark.filterwarnings("ignore:Casting complex values")
def test_from_qnode_falls_back_on_the_qnodes_device_and_says_so():
    for change, reason in (
        (lambda node: qml.set_shots(node, 10), "finite shots are not computed"),
        (qml.transforms.merge_rotations, "transforms"),
        (lambda node: qml.QNode(node.func, qml.device("default.mixed", wires=2)), "another device than an exact sim"),
        (lambda node: qml.QNode(node.func, node.device, diff_method=None), "diff_method=None"),
        (
            lambda node: qml.QNode(measuring(qml.state), node.device),
            "the measurement State is not computed; known: exp",
        ),
        (lambda node: qml.QNode(measuring(lambda: (qml.measure(0), qml.probs(0))[1]), FREE), "MidMeasure"),
    ):
        layer = from_qnode(change(NODE), {"weights": (3, 2, 3)})
        with pytest.warns(UserWarning, match=f"from_qnode runs .* on default.*: {reason}"):
            first = layer(torch.rand(3, 2))
        assert layer(torch.rand(3, 2)).shape == first.shape  # one warning for a layer
        assert layer.runs_on.startswith("default.")


@pytest.mark.filterwarnings("ignore:from_qnode runs")
def test_from_qnode_refuses_what_pennylane_refuses():
    for operation in (
        lambda x: qml.BitFlip(0.1, wires=0),
        lambda x: qml.AmplitudeEmbedding(x, wires=0, pad_with=0.0),
        lambda x: qml.AmplitudeEmbedding(x, wires=0),
        lambda x: qml.AmplitudeEmbedding(x[..., :2] + 1, wires=0, normalize=False),
        lambda x: qml.AngleEmbedding(x, wires=[0]),
        lambda x: qml.RX(x[..., 7], wires=0),
        lambda x: qml.X(5),
        lambda x: (qml.RX(x[:, 0], 0), qml.RX(x[:3, 0], 0)),
        lambda x: [qml.RX(value, 0) for value in x],
    ):
        compare(*both(queuing(operation), {}, 1), torch.rand(4, 3), "")
    for shapes in ({}, {"w": 2, "u": 1}, {"inputs": 1, "w": 2}):
        messages = []
        for make in (from_qnode, qml.qnn.TorchLayer):
            with pytest.raises((ValueError, TypeError)) as raised:
                make(qml.QNode(lambda inputs, w: qml.expval(qml.Z(0)), NODE.device), shapes)
            messages.append(str(raised.value))
        assert messages[0] == messages[1]


def queuing(operation):
    def function(inputs):
        operation(inputs)
        return qml.expval(qml.Z(0))

    return function


def test_circuit_of_a_qnode_is_made_of_polynomials_alone():
    cases = [
        (lambda x: qml.RX(np.sin(x[0]), wires=0), "sin"),
        (lambda x: qml.RX(1 / x[0], wires=0), "unsupported operand"),
        (lambda x: x[0] > 1 and qml.X(0), "'>' not supported"),
        (lambda x: qml.X(0) if x[0] == 1 else None, "the form of a circuit cannot depend on the value of an input"),
        (lambda x: qml.AmplitudeEmbedding(x, wires=0, normalize=True), ""),
    ]
    for operation, message in cases:
        with pytest.raises(
            ValueError, match=f"function is no circuit of polynomials of inputs and weights: .*{message}"
        ):
            both(queuing(operation), {}, 1)[0].circuit(2)
    batched, _ = both(queuing(lambda x: qml.RX(x[:, 0] * x[:, 1], wires=0)), {}, 1)
    x = torch.rand(3, 2)
    torch.testing.assert_close(QuantumLayer(batched.circuit(2))(x)[:, 0], batched(x))


def rotated():
    node = qml.QNode(at_module_level, qml.device("default.qubit", wires=2))
    return from_qnode(node, {"weights": (2, 2, 3)})


def test_from_qnode_sees_a_parameter_that_was_replaced():
    """By load_state_dict(assign=True), torch.func, pruning, a parametrisation or an assignment."""
    x, zeros = torch.rand(3, 2), torch.zeros(2, 2, 3)
    layer, expected = rotated(), rotated()
    with torch.no_grad():
        expected.weights.zero_()
    assert not torch.allclose(layer(x), expected(x))
    assert torch.equal(functional_call(layer, {"weights": zeros}, (x,)), expected(x))
    layer.load_state_dict({"weights": zeros}, assign=True)
    assert torch.equal(layer(x), expected(x))
    assert torch.equal(copy.deepcopy(layer)(x), expected(x))
    layer = rotated()
    layer.weights = nn.Parameter(zeros)
    assert torch.equal(layer(x), expected(x))
    layer = prune.l1_unstructured(rotated(), "weights", amount=12)
    assert torch.equal(layer(x), expected(x))
    layer = rotated()
    parametrize.register_parametrization(layer, "weights", Zero())
    assert torch.equal(layer(x), expected(x))


class Zero(nn.Module):
    def forward(self, x):
        return 0 * x


def test_layer_used_under_inference_mode_trains_and_takes_negated_and_empty_batches():
    for kind in ((rotated().circuit(2),), (2, 1)):
        for options in ({}, {"shots": 10}, {"noise": {"readout": 0.01}, "shots": 10}):
            layer = QuantumLayer(*kind, **options, seed=0)
            x = torch.rand(3, 2)
            with torch.inference_mode():
                layer(x)
            out = layer(torch._neg_view(-x))
            assert torch.equal(out, layer(x)) or options
            (out * torch.tensor(1j)).imag.sum().backward()
            torch.imag(torch.conj(layer(x) * torch.tensor(1j))).sum().backward()
            assert layer(x[:0]).shape == (0, out.shape[1])


def test_from_qnode_takes_any_names_empty_batches_and_is_compiled():
    def function(inputs, **weights):
        for _ in range(2):
            qml.RX(inputs[..., 0] + weights["a"], wires=0)
        return [qml.expval(qml.Z(0)), qml.probs(wires=0)]

    layer, _ = both(function, {"a": ()})
    x = torch.rand(3, 2, requires_grad=True)
    torch.testing.assert_close(layer(x)[:, 0], (2 * (x[:, 0] + layer.a)).cos())
    assert layer(x[:0]).shape == (0, 3)
    assert layer(x[None, :0]).shape == (1, 0, 3)
    compiled = torch.compile(layer, backend="aot_eager")
    torch.testing.assert_close(compiled(x.detach()), layer(x))
    for wrong, kind in ((x.int(), "a tensor of torch.int32"), (np.zeros((2, 2)), "ndarray")):
        with pytest.raises(ValueError, match=f"floating-point tensor .*, got {kind}"):
            layer(wrong)
    with pytest.raises(ValueError, match="expects a QNode, as"):
        from_qnode(function, {})
