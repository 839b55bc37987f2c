"""Errors of gates and of the readout: sampled Pauli errors against density matrices, and these against PennyLane."""

from math import exp, pi
from typing import Any

import numpy as np
import pennylane as qml
import pytest
import torch
from torch import Tensor

from qnerf.quantum import QuantumLayer, folded_errors, pauli_errors
from qnerf.quantum.circuit import Circuit, Encoding, Entangler, Rotations
from qnerf.quantum.diagnostics import weights_of
from qnerf.quantum.hardware_conditions import conditions
from qnerf.quantum.noise import Noise
from qnerf.quantum.pennylane import apply, observables

RELAXATION = {"t1": 50e-6, "t2": 30e-6, "one_qubit_time": 1e-6, "two_qubit_time": 4e-6}
ENCODED_FIRST = Circuit(
    "first", 3, 2, 1,
    (Encoding("X", (1.0, 1.0, 2.0)), Entangler("CNOT", ((0, 1), (2, 0))), Rotations(0), Entangler("CZ", ((1, 2),)),
     Encoding("Y", (1.0,) * 3), Entangler("CNOT", ((1, 0),)), Rotations(2)),
    (((0, "X"),), ((1, "Y"), (2, "Z"))),
)  # fmt: skip


def made(circuit: str | Circuit) -> tuple[QuantumLayer, Tensor]:
    torch.manual_seed(3)
    layer = QuantumLayer(circuit) if isinstance(circuit, Circuit) else QuantumLayer(3, 2, ansatz=circuit)
    return layer.double(), torch.randn(40, 3, dtype=torch.float64)


class Rotated:
    """In the place of a `Noise`: after each gate the next Pauli errors of a pattern, as rotations by pi."""

    def __init__(self, x_errors: np.ndarray, z_errors: np.ndarray) -> None:
        self.errors = zip(x_errors, z_errors, strict=True)

    def after(self, wires: int) -> list[tuple[str, float]]:
        x, z = next(self.errors)
        return [("RX", pi)] * int(x) + [("RZ", pi)] * int(z)


@pytest.mark.parametrize("circuit", ["qiren", "cnot", "rx", "pauli_x", ENCODED_FIRST])
def test_errors_in_the_weights_are_errors_after_the_gates(circuit: str | Circuit) -> None:
    layer, x = made(circuit)
    weights = weights_of(layer)
    sizes = pauli_errors.spots(layer.circuit)
    _, *errors = pauli_errors.draw(sizes, Noise(depolarizing=0.3), 3, np.random.default_rng(0))
    signs, shifts = folded_errors.fold(layer.circuit, *errors)
    for pattern in range(3):
        folded = layer.evaluate(x[:2], weights * torch.from_numpy(signs[pattern]) + torch.from_numpy(shifts[pattern]))
        rotated = Rotated(*(part[pattern] for part in errors))

        @qml.qnode(qml.device("default.qubit", wires=3))
        def node(rotated: Any) -> list[Any]:
            apply(layer.circuit, x[0].numpy(), weights.numpy(), rotated)
            return [qml.expval(observable) for observable in observables(layer.circuit)]

        assert np.abs(folded[0].numpy() - np.array(node(rotated))).max() < 1e-12
        assert next(rotated.errors, None) is None  # every spot was used


@pytest.mark.parametrize("circuit", ["qiren", ENCODED_FIRST])
@pytest.mark.parametrize(
    "noise", [Noise(depolarizing=0.02, two_qubit=0.05), Noise(bit_flip=0.02, phase_damping=0.05, readout=0.03)]
)
def test_sampled_pauli_errors_agree_with_density_matrices(circuit: str | Circuit, noise: Noise) -> None:
    layer, x = made(circuit)
    with conditions(layer, noise=noise, method="density"):
        expected = layer(x)
    with conditions(layer, noise=noise, method="sampled", patterns=600) as measured:
        off = layer(x) - expected
    assert 0.002 < measured.standard_error < 0.02
    assert off.square().mean().sqrt() < 2 * measured.standard_error  # 80 to 120 outputs share the patterns
    assert (expected - layer(x)).square().mean().sqrt() > 3 * measured.standard_error


def test_the_standard_error_is_the_spread_over_seeds_and_follows_the_seed() -> None:
    layer, x = made("qiren")
    runs, errors = [], []
    for seed in (*range(40), 0):
        with conditions(layer, noise=0.01, method="sampled", patterns=20, seed=seed) as measured:
            runs.append(layer(x).detach())
        errors.append(measured.standard_error)
    assert torch.equal(runs[0], runs[-1])
    spread = torch.stack(runs[:-1]).std(0).square().mean().sqrt()
    assert 0.8 < np.sqrt(np.square(errors).mean()) / spread < 1.25


def test_derivatives_with_sampled_noise_are_those_of_the_patterns() -> None:
    layer, x = made("cnot")
    x = x[:1].requires_grad_()
    weights = weights_of(layer).requires_grad_()

    def measured(x: Tensor, weights: Tensor) -> Tensor:
        with conditions(layer, noise=0.05, method="sampled", patterns=2, gradients=True):
            return layer.evaluate(x, weights)

    assert torch.autograd.gradcheck(measured, (x, weights))


def node_of(layer: QuantumLayer, x: Tensor, noise: Noise, readout: float) -> np.ndarray:
    weights = weights_of(layer).numpy()

    @qml.qnode(qml.device("default.mixed", wires=3))
    def node(sample: np.ndarray) -> list[Any]:
        apply(layer.circuit, sample, weights, noise)
        for wire in range(3):
            qml.BitFlip(readout, wires=wire)
        return [qml.expval(observable) for observable in observables(layer.circuit)]

    return np.array([node(sample) for sample in x.numpy()])


def test_rates_of_gates_readout_and_relaxation_equal_default_mixed() -> None:
    layer, x = made("qiren")
    noise = Noise(depolarizing=0.01, two_qubit=0.04, **RELAXATION)
    with conditions(layer, noise=Noise(depolarizing=0.01, two_qubit=0.04, readout=0.03, **RELAXATION)):
        assert np.abs(layer(x[:2]).detach().numpy() - node_of(layer, x[:2], noise, 0.03)).max() < 1e-12
    with conditions(layer, noise=noise):
        without = layer(x)
    with conditions(layer, noise=Noise(depolarizing=0.01, two_qubit=0.04, readout=(0.01, 0.04), **RELAXATION)):
        assert torch.allclose(layer(x), 0.95 * without + 0.03, atol=1e-12)


def test_thermal_relaxation_is_that_of_pennylane() -> None:
    channels = Noise(**RELAXATION).after(2)
    assert [name for name, _ in channels] == ["AmplitudeDamping", "PhaseDamping"]
    rho = np.array([[0.3, 0.2 + 0.1j], [0.2 - 0.1j, 0.7]])
    ours = theirs = rho
    for name, probability in channels:
        kraus = getattr(qml, name).compute_kraus_matrices(probability)
        ours = sum(k @ ours @ k.conj().T for k in kraus)
    kraus = qml.ThermalRelaxationError.compute_kraus_matrices(0.0, 50e-6, 30e-6, 4e-6)
    theirs = sum(k @ theirs @ k.conj().T for k in kraus)
    assert np.abs(ours - theirs).max() < 1e-12
    assert ours[1, 1] == pytest.approx(0.7 * exp(-4 / 50))


def test_the_pauli_twirl_keeps_the_diagonal_of_the_transfer_matrix() -> None:
    paulis = [np.array(m) for m in ([[0, 1], [1, 0]], [[0, -1j], [1j, 0]], [[1, 0], [0, -1]])]
    noise = Noise(depolarizing=0.1, amplitude_damping=0.2, phase_damping=0.3, bit_flip=0.05)
    mixed = noise.pauli_probabilities(1)
    for letter, pauli in enumerate(paulis):
        state = pauli
        for kraus in noise.kraus_operators(1):
            state = sum(k.numpy() @ state @ k.numpy().conj().T for k in kraus)
        kept = np.trace(pauli @ state).real / 2
        assert 1 - 2 * (sum(mixed) - mixed[letter]) == pytest.approx(kept)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"t1": 1.0, "t2": 3.0, "one_qubit_time": 1.0}, "t2 expects at most 2 t1 = 2, got 3"),
        ({"t1": 1.0}, "also expect one_qubit_time"),
        ({"readout": (0.1, 1.2)}, r"readout expects a probability in \[0, 1\], got 1.2"),
        ({"cross_talk": 0.1}, "unknown field 'cross_talk'; known: depolarizing"),
    ],
)
def test_impossible_noise_is_one_line(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Noise.of(fields)


def test_a_layer_trains_with_shots_whose_gradients_are_exact() -> None:
    layer, x = made("qiren")
    measured = QuantumLayer(3, 2, shots=50).double()
    measured.load_state_dict(layer.state_dict())
    exact = layer(x[:1]).detach()
    draws = measured(x[:1].expand(4000, 3))
    deviation = ((1 - exact.square()) / 50).sqrt()[0]
    assert torch.allclose(draws.std(0), deviation, rtol=0.1)
    assert ((draws.mean(0) - exact).abs() < 5 * deviation / 4000**0.5).all()
    losses = (layer(x).sum(), measured(x).sum())
    gradients = [
        torch.autograd.grad(loss, model.weights1)[0] for loss, model in zip(losses, (layer, measured), strict=False)
    ]
    assert losses[0] != losses[1]
    assert torch.allclose(gradients[0][0], gradients[1][0], atol=1e-12)


def test_a_layer_trains_with_noise_that_is_right_on_average() -> None:
    layer, x = made("cnot")
    noisy = QuantumLayer(3, 2, ansatz="cnot", noise={"depolarizing": 0.02, "readout": 0.05}, patterns=5).double()
    noisy.load_state_dict(layer.state_dict())
    with conditions(layer, noise=Noise(depolarizing=0.02, readout=0.05), method="density"):
        expected = layer(x).detach()
    torch.manual_seed(0)
    draws = torch.stack([noisy(x).detach() for _ in range(100)])
    error = draws.std(0).square().mean().sqrt() / 10
    assert (draws.mean(0) - expected).square().mean().sqrt() < 2 * error < 0.02
    noisy(x).sum().backward()
    assert noisy.weights1.grad is not None
    assert noisy.weights1.grad.abs().max() > 0
    with conditions(noisy):
        assert torch.equal(noisy(x).detach(), layer(x).detach())  # exact again


def test_a_device_with_options_or_as_an_object() -> None:
    torch.manual_seed(0)
    layer = QuantumLayer(2, 1)
    x = torch.randn(2, 2)
    device = qml.device("default.qubit", wires=3)
    other = QuantumLayer(2, 1, method="pennylane", device=device)
    options = QuantumLayer(2, 1, method="pennylane", device="default.qubit", device_options={"max_workers": None})
    for model in (other, options):
        model.load_state_dict(layer.state_dict())
        assert torch.allclose(model(x), layer(x), atol=1e-5)
    for wrong, message in (
        ({"device": device, "seed": 1}, "is given as an object"),
        ({"device": qml.device("default.qubit", wires=1)}, "has 1 wires, the circuit needs 2"),
        ({"device": 3}, "device expects str or Device, got 3"),
        ({"device_options": {"colour": 1}}, "cannot make 'default.qubit'"),
        ({"noise": Noise(readout=0.1)}, "an option of the device"),
    ):
        with pytest.raises(ValueError, match=message):
            QuantumLayer(2, 1, method="pennylane", **wrong)  # type: ignore[arg-type]
