"""Finite shots, conditions of a whole model, and PennyLane devices."""

import copy
import pickle

import numpy as np
import pennylane as qml
import pytest
import torch

from qnerf.quantum import diagnostics, from_qnode, hardware_conditions
from qnerf.quantum.layer import QuantumLayer
from qnerf.quantum.noise import Noise
from qnerf.quantum.pennylane import apply, measurements
from tests.quantum.test_any_circuit import MIXED


def test_finite_shots_have_the_statistics_of_independent_draws():
    torch.manual_seed(2)
    layer = QuantumLayer(3, 1).double()
    x = torch.randn(1, 3, dtype=torch.float64)
    exact = layer(x)[0].detach()
    shots, repeats = 100, 4000
    with hardware_conditions.conditions(layer, shots=shots, seed=1):
        y = layer(x.expand(repeats, 3))
    with pytest.raises(ValueError, match="carry no gradients"):
        y.sum().backward()
    y = y.detach()
    deviation = ((1 - exact.square()) / shots).sqrt()
    assert ((y.mean(0) - exact).abs() < 5 * deviation / repeats**0.5).all()
    assert torch.allclose(y.std(0), deviation, rtol=0.06)
    assert np.abs(np.corrcoef(y.T.numpy()) - np.eye(3)).max() < 0.08
    assert torch.equal(layer(x)[0].detach(), exact)  # the conditions end with the block


def test_shots_follow_the_seed_and_keep_nan_and_empty_batches():
    layer = QuantumLayer(2, 1)
    x = torch.randn(5, 2)
    x[1, 0] = float("nan")
    outputs = []
    for seed in (1, 1, 2):
        with hardware_conditions.conditions(layer, shots=20, seed=seed):
            outputs.append(layer(x))
    assert torch.equal(outputs[0].nan_to_num(9), outputs[1].nan_to_num(9))
    assert not torch.equal(outputs[0].nan_to_num(9), outputs[2].nan_to_num(9))
    assert outputs[0].isnan().all(1).nonzero().flatten().tolist() == [1]
    for options in ({"shots": 10}, {"noise": Noise(depolarizing=0.1)}):
        with hardware_conditions.conditions(layer, **options):
            assert layer(torch.zeros(0, 2)).shape == (0, 2)


def test_shots_of_any_circuit_are_drawn_around_its_exact_values():
    layer = QuantumLayer(MIXED).double()
    x = torch.randn(400, MIXED.features or 0, dtype=torch.float64)
    exact = layer(x).detach()
    with hardware_conditions.conditions(layer, shots=1000, seed=0):
        drawn = layer(x)
    off = (drawn - exact).detach()
    assert 0.001 < off.std() < 0.05
    assert off.mean(0).abs().max() < 0.01
    probabilities = drawn[:, -4:]
    torch.testing.assert_close(probabilities.sum(1), torch.ones(400, dtype=torch.float64))
    torch.testing.assert_close((probabilities * 1000).round(), probabilities * 1000)


def test_conditions_that_are_wrong_are_refused():
    layer = QuantumLayer(2, 1)
    for options in ({"shots": 0}, {"shots": 2.5}, {"noise": 1.5}, {"noise": Noise}, {"method": "x"}, {"patterns": 0}):
        with pytest.raises(ValueError), hardware_conditions.conditions(layer, **options):  # noqa: PT011
            pass


def test_conditions_and_diagnostics_of_a_circuit_of_pennylane_are_refused_with_the_cure():
    @qml.qnode(qml.device("default.qubit", wires=2))
    def circuit(inputs, w):
        qml.AngleEmbedding(inputs, wires=range(2))
        qml.StronglyEntanglingLayers(w, wires=range(2))
        return [qml.expval(qml.Z(0)), qml.expval(qml.Z(1))]

    layer = from_qnode(circuit, {"w": (2, 2, 3)})
    model, x = torch.nn.Sequential(torch.nn.Linear(2, 2), layer), torch.rand(5, 2)
    for noise, shots in ((None, 10), (0.1, None)):
        refused = pytest.raises(ValueError, match=r"got Sequential.* QuantumLayer\(layer.circuit\(features\)\)")
        with refused, hardware_conditions.conditions(model, noise=noise, shots=shots):
            pass
    for diagnostic in (diagnostics.expressibility, diagnostics.entangling_capability):
        with pytest.raises(ValueError, match=r"got TorchLayer.* QuantumLayer\(layer.circuit\(features\)\)"):
            diagnostic(layer)
    cured = QuantumLayer(layer.circuit(2))
    cured.load_state_dict(layer.state_dict())
    torch.testing.assert_close(cured(x), layer(x))
    both = torch.nn.Sequential(cured, layer)
    warned = pytest.warns(UserWarning, match="1: circuits of PennyLane stay")
    with warned, torch.no_grad(), hardware_conditions.conditions(both, shots=10):
        assert not torch.equal(cured(x), layer(x))


def test_a_circuit_trains_on_any_device_of_pennylane():
    layer = QuantumLayer(2, 1).double()
    x = torch.randn(2, 2, dtype=torch.float64)
    weights = torch.cat([layer.weights1.flatten(), layer.weights2.flatten()]).detach()
    expected = torch.autograd.grad(layer(x).square().sum(), (layer.weights1, layer.weights2))
    for method in ("parameter-shift", "adjoint"):

        @qml.qnode(qml.device("default.qubit", wires=2), diff_method=method)
        def node(inputs, weights):
            apply(layer.circuit, inputs, weights)
            return measurements(layer.circuit)

        model = qml.qnn.TorchLayer(node, {"weights": layer.circuit.size}, init_method={"weights": weights})
        found = torch.stack([model(sample) for sample in x])
        (ours,) = torch.autograd.grad(found.square().sum(), model.weights)
        torch.testing.assert_close(ours, torch.cat([e.flatten() for e in expected]), rtol=0, atol=1e-10)


def test_the_layer_on_pennylane_has_shots_and_noise_and_can_be_copied():
    layer = QuantumLayer(2, 1, method="pennylane", shots=50, noise={"readout": 0.02}, seed=3)
    x = torch.randn(3, 2)
    copies = pickle.loads(pickle.dumps(layer)), copy.deepcopy(layer)
    steps = (layer(x) + 1) * 25
    assert torch.allclose(steps, steps.round(), atol=1e-4)
    for copied in copies:
        assert torch.equal((copied(x) + 1) * 25, steps)
