"""PennyLane devices, finite shots and noise."""

import copy
import pickle
from typing import Any

import numpy as np
import pennylane as qml
import pytest
import torch

from qnerf.quantum import hardware_conditions, statevector
from qnerf.quantum.circuit import ANSATZE
from qnerf.quantum.diagnostics import weights_of
from qnerf.quantum.layer import QuantumLayer
from qnerf.quantum.noise import Noise
from qnerf.quantum.normal_form import normal_form
from qnerf.quantum.pennylane import apply, draw, make_node, observables
from tests.quantum.test_any_circuit import MIXED


@pytest.mark.parametrize("diff_method", ["parameter-shift", "adjoint"])
def test_differentiation_methods_agree(diff_method: str) -> None:
    torch.manual_seed(0)
    layer = QuantumLayer(2, 1).double()
    other = QuantumLayer(2, 1, method="pennylane", diff_method=diff_method).double()
    other.load_state_dict(layer.state_dict())
    x = torch.randn(2, 2, dtype=torch.float64)
    inputs = [x.clone().requires_grad_(), x.clone().requires_grad_()]
    for model, values in zip((layer, other), inputs, strict=True):
        model(values).square().sum().backward()
    assert torch.allclose(inputs[0].grad, inputs[1].grad, atol=1e-10)
    assert torch.allclose(layer.weights1.grad, other.weights1.grad, atol=1e-10)
    assert torch.allclose(layer.weights2.grad, other.weights2.grad, atol=1e-10)


def test_shots_of_a_pennylane_device() -> None:
    torch.manual_seed(0)
    layer = QuantumLayer(2, 1, method="pennylane", diff_method="parameter-shift", shots=50, seed=3)
    y = layer(torch.randn(2, 2))
    steps = (y + 1) * 25
    assert torch.allclose(steps, steps.round(), atol=1e-4)


def exact_correlation(layer: QuantumLayer, x: torch.Tensor) -> np.ndarray:
    """Correlation of the signs read on all wires, from the exact probabilities."""
    weights = weights_of(layer)
    probabilities = statevector.probabilities(normal_form(layer.circuit), x, weights)[0].numpy()
    signs = 1 - 2 * ((np.arange(8)[:, None] >> np.arange(2, -1, -1)) & 1)
    mean = probabilities @ signs
    covariance = (signs - mean).T @ ((signs - mean) * probabilities[:, None])
    return covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))


@pytest.mark.parametrize("joint", [True, False])
def test_finite_shots_have_the_statistics_of_measuring_all_wires(joint: bool) -> None:
    torch.manual_seed(2)
    layer = QuantumLayer(3, 1).double()
    x = torch.randn(1, 3, dtype=torch.float64)
    exact = layer(x)[0].detach()
    shots, repeats = 100, 4000
    with hardware_conditions.conditions(layer, shots=shots, joint=joint, seed=1):
        y = layer(x.expand(repeats, 3))
    with pytest.raises(ValueError, match="carry no gradients"):
        y.sum().backward()
    y = y.detach()
    deviation = ((1 - exact.square()) / shots).sqrt()
    assert ((y.mean(0) - exact).abs() < 5 * deviation / repeats**0.5).all()
    assert torch.allclose(y.std(0), deviation, rtol=0.06)
    correlation = np.corrcoef(y.T.numpy())
    expected = exact_correlation(layer, x) if joint else np.eye(3)
    assert np.abs(correlation - expected).max() < 0.08
    assert np.abs(exact_correlation(layer, x) - np.eye(3)).max() > 0.2  # joint sampling is not independent sampling
    assert torch.equal(layer(x)[0].detach(), exact)  # the conditions end with the block


@pytest.mark.parametrize("options", [{"shots": 10}, {"shots": 10, "joint": False}, {"noise": Noise(depolarizing=0.1)}])
def test_no_samples_are_measured_as_none(options: dict[str, Any]) -> None:
    layer = QuantumLayer(3, 1)
    with hardware_conditions.conditions(layer, **options):
        assert layer(torch.zeros(0, 3)).shape == (0, 3)


def test_shots_follow_the_seed_and_keep_nan() -> None:
    torch.manual_seed(0)
    layer = QuantumLayer(2, 1)
    x = torch.randn(5, 2)
    x[1, 0] = float("nan")
    outputs = []
    for seed in (1, 1, 2):
        with hardware_conditions.conditions(layer, shots=20, seed=seed):
            outputs.append(layer(x))
    assert torch.equal(outputs[0].nan_to_num(9), outputs[1].nan_to_num(9))
    assert not torch.equal(outputs[0].nan_to_num(9), outputs[2].nan_to_num(9))
    assert outputs[0][1].isnan().all()
    assert not outputs[0][0].isnan().any()


@pytest.mark.parametrize(
    "noise", [Noise(depolarizing=0.03), Noise(bit_flip=0.02, phase_damping=0.1), Noise(amplitude_damping=0.05)]
)
@pytest.mark.parametrize(("name", "spectral"), [("qiren", 1), ("cnot", 2), ("rx", 1)])
def test_noise_equals_default_mixed(noise: Noise, name: str, spectral: int) -> None:
    torch.manual_seed(0)
    layer = QuantumLayer(2, spectral, ansatz=name).double()
    x = torch.randn(90, 2, dtype=torch.float64)  # more than the grid: the polynomial where there is one
    weights = weights_of(layer)

    # On NumPy arrays: with torch tensors PennyLane forms its channels in single precision.
    @qml.qnode(qml.device("default.mixed", wires=2))
    def node(sample: np.ndarray) -> list[Any]:
        apply(layer.circuit, sample, weights.numpy(), noise)
        return [qml.expval(observable) for observable in observables(layer.circuit)]

    expected = torch.tensor(np.array([node(sample) for sample in x[:2].numpy()]))
    single = make_node(layer.circuit, device="default.mixed", noise=noise)(x[:2], weights)
    assert (single - expected).abs().max() < 1e-6
    with hardware_conditions.conditions(layer, noise=noise):
        assert (layer(x)[:2] - expected).abs().max() < 1e-12
        assert (layer(x[:2]) - expected).abs().max() < 1e-12


def test_noise_shrinks_signals_and_zero_noise_does_nothing() -> None:
    torch.manual_seed(0)
    layer = QuantumLayer(3, 1)
    x = torch.randn(100, 3)
    exact = layer(x)
    spread = []
    for p in (0.0, 0.01, 0.1):
        with hardware_conditions.conditions(layer, noise=p):
            spread.append(layer(x))
    assert torch.allclose(spread[0], exact, atol=1e-6)
    assert spread[2].std() < spread[1].std() < exact.std()


@pytest.mark.parametrize("options", [{"shots": 0}, {"shots": 2.5}, {"noise": 1.5}, {"noise": Noise}])
def test_wrong_conditions(options: dict[str, object]) -> None:
    with pytest.raises((ValueError, TypeError)), hardware_conditions.conditions(QuantumLayer(2, 1), **options):  # type: ignore[arg-type]
        pass


def test_the_drawing_shows_every_gate() -> None:
    text = draw(ANSATZE.build("qiren", 3, 1))
    assert text.count("Rot") == 12
    assert text.count("RZ") == 3
    assert text.count("<Z>") == 3


def test_noise_on_a_device_without_channels_is_refused_at_once():
    with pytest.raises(ValueError, match=r"default\.qubit takes no channels"):
        QuantumLayer(2, 1, method="pennylane", noise=Noise(depolarizing=0.1))


def test_a_layer_on_a_pennylane_device_can_be_pickled_and_copied():
    layer = QuantumLayer(2, 1, method="pennylane", diff_method="parameter-shift", shots=50, seed=3)
    x = torch.randn(3, 2)
    expected = layer(x)
    fresh = QuantumLayer(2, 1, method="pennylane", diff_method="parameter-shift", shots=50, seed=3)
    fresh.load_state_dict(layer.state_dict())
    for copied in (pickle.loads(pickle.dumps(fresh)), copy.deepcopy(fresh)):
        assert torch.equal(copied(x), expected)


def test_shots_of_any_circuit_are_drawn_around_its_exact_values() -> None:
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
    trained = QuantumLayer(MIXED, shots=100).double()
    trained(x).sum().backward()
    assert trained.w.grad is not None
