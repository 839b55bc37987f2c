import pennylane as qml
import pytest
import torch

from qnerf.heads import HEADS
from qnerf.quantum.circuit import ANSATZE, Circuit, Gate, feature


def test_heads_map_features_to_values_and_learn():
    for name in HEADS.names():
        for dtype, mixed in ((torch.float64, False), (torch.float32, True)):  # float32 alone: tests/config/test_conf.py
            torch.manual_seed(0)
            head = HEADS.build(name, 5, 3).to(dtype)
            with torch.autocast("cpu", torch.bfloat16, enabled=mixed):
                values = head(torch.randn(16, 5, dtype=dtype))
            assert values.shape == (16, 3), name
            assert mixed or values.dtype == dtype, name
            values.square().sum().backward()
            gradients = [p.grad for p in head.parameters() if name != "residual" or p.grad is not None]
            assert gradients, name
            assert all(gradient is not None and gradient.dtype == dtype for gradient in gradients), name


def test_qiren_is_what_its_published_code_computes():
    """After the code of arXiv:2406.03873: linear maps, batch normalisation and PennyLane's templates, a linear map."""
    head = HEADS.build("qiren", 3, 2, layers=1, spectral=2, qubits=4).double().eval()

    @qml.qnode(qml.device("default.qubit", wires=4))
    def circuit(inputs, weights1, weights2):
        for weights in weights1:
            qml.StronglyEntanglingLayers(weights, wires=range(4), imprimitive=qml.CZ)
            qml.AngleEmbedding(inputs, wires=range(4), rotation="Z")
        qml.StronglyEntanglingLayers(weights2, wires=range(4), imprimitive=qml.CZ)
        return [qml.expval(qml.Z(wire)) for wire in range(4)]

    values = x = torch.randn(5, 3, dtype=torch.float64)
    for layer in head.hybrid:
        torch.nn.init.normal_(layer.norm.running_mean)
        torch.nn.init.uniform_(layer.norm.running_var, 0.5, 2.0)
        linear = values @ layer.linear.weight.T + layer.linear.bias
        spread = torch.sqrt(layer.norm.running_var + layer.norm.eps)
        normal = (linear - layer.norm.running_mean) / spread * layer.norm.weight + layer.norm.bias
        values = torch.stack(circuit(normal, layer.circuit.weights1, layer.circuit.weights2), 1)
    torch.testing.assert_close(head(x), values @ head.readout.weight.T + head.readout.bias)


def test_sum_layers_adds_the_measured_values_of_all_circuits():
    head = HEADS.build("qiren", 4, 2, layers=2, spectral=1, qubits=3, gain=2.5, sum_layers=True).double().eval()
    x = torch.randn(7, 4, dtype=torch.float64)
    first = head.hybrid[0](x)
    second = head.hybrid[1](first)
    third = head.hybrid[2](second)
    torch.testing.assert_close(head(x), head.readout(2.5 * (first + second + third)))
    head.sum_layers = False
    torch.testing.assert_close(head(x), head.readout(2.5 * third))


def test_input_scale_acts_after_the_normalisation():
    plain = HEADS.build("qiren", 4, 2, qubits=3).double().eval()
    torch.manual_seed(0)
    scaled = HEADS.build("qiren", 4, 2, qubits=3, input_scale=3.0).double().eval()
    angles = plain.hybrid[0].norm(plain.hybrid[0].linear(x := torch.randn(5, 4, dtype=torch.float64)))
    torch.testing.assert_close(scaled.hybrid[0](x), plain.hybrid[0].circuit(3 * angles))


def test_qfgn_feeds_gaussian_weighted_fourier_features_to_the_circuit():
    layer = HEADS.build("qfgn", 4, 2, features=6, gamma=0.7, qubits=3).double().hybrid[0]
    x = torch.randn(5, 4, dtype=torch.float64)
    phases = x @ layer.frequencies.T
    h = layer.linear(torch.cat([phases.cos(), phases.sin()], 1))
    torch.testing.assert_close(layer(x), layer.circuit(torch.exp(-0.7 * h**2) * h))


MISTAKES = [
    ("qfgn", {"features": 3}, "even"),
    ("qiren", {"ansatz": "with_gates", "unitary": "local"}, "has CRX, which is one with an angle: register a variant"),
    ("amplitude", {"registers": [6, 6]}, "at most 10 qubits together"),
    ("amplitude", {"branch": "amplitude"}, "expects two registers"),
    ("amplitude", {"encoding": "none"}, "uploads of at least 1"),
    ("hyper", {"qubits": 11}, "qubits must be between 1 and 10, got 11"),
    ("amplitude", {"readout": False, "values": "Z", "registers": [1]}, "expects at least 2 values, got 1"),
]


def with_gates(wires, spectral):
    gates = Gate("RX", (0,), (feature(0),)), Gate("CRX", (0, 1), (feature(0),))
    return Circuit("with_gates", wires, operations=gates, observables=(((0, "Z"),),), features=1)


def test_heads_refuse_bad_options_in_one_line(monkeypatch):
    monkeypatch.setitem(ANSATZE._components, "with_gates", with_gates)
    for name, options, message in MISTAKES:
        with pytest.raises(ValueError, match=message) as caught:
            HEADS.build(name, 5, 2, **options)
        assert "\n" not in str(caught.value)


def test_centred_heads_start_at_0_for_the_mean_of_their_inputs():
    for sum_layers in (False, True):
        options = {"qubits": 4, "gain": 10.0, "sum_layers": sum_layers, "init": "eighth", "input_scale": 0.3}
        plain, centred = (HEADS.build("qiren", 5, 3, center=center, **options).double() for center in (False, True))
        features = torch.randn(1, 5, dtype=torch.float64).expand(64, -1)  # a constant is its own mean
        assert plain(features).abs().max() > 0.1
        torch.testing.assert_close(centred(features), torch.zeros(64, 3, dtype=torch.float64), atol=1e-5, rtol=0)


def test_statistics_of_the_first_step_stay():
    head = HEADS.build("qiren", 4, 2, qubits=3, statistics="first").double()
    norm = head.hybrid[0].norm
    first, second = torch.randn(64, 4, dtype=torch.float64), 5 + 3 * torch.randn(64, 4, dtype=torch.float64)
    angles = norm(head.hybrid[0].linear(first))
    torch.testing.assert_close(angles.mean(0), torch.zeros(3, dtype=torch.float64), atol=1e-12, rtol=0)
    torch.testing.assert_close(angles.var(0, unbiased=False), torch.ones(3, dtype=torch.float64), atol=1e-3, rtol=0)
    head(first)
    values = head(second)
    assert float(norm(head.hybrid[0].linear(second)).detach().mean(0).abs().max()) > 0.5  # not normalised anew
    values.sum().backward()
    assert float(head.hybrid[0].linear.bias.grad.abs().max()) > 0
    assert head(second[:1]).shape == (1, 2)
    torch.testing.assert_close(head.eval()(second), values)
    again = HEADS.build("qiren", 4, 2, qubits=3, statistics="first").double()
    again.load_state_dict(head.state_dict())
    torch.testing.assert_close(again(second), values)


def test_mlp_that_is_deep_varies_at_the_start_as_its_initialisation_says():
    features = torch.randn(500, 21)
    for init, low, high in (("torch", 0.0, 0.05), ("he", 0.3, 10.0)):
        spreads = [HEADS.build("mlp", 21, 3, layers=8, width=64, init=init)(features).std(0).mean() for _ in range(8)]
        assert low < float(torch.stack(spreads).detach().median()) < high
