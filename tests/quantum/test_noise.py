"""Noise: patterns of errors against gates, samples against density matrices, these against PennyLane."""

from dataclasses import replace
from itertools import product
from math import exp

import numpy as np
import pennylane as qml
import pytest
import torch
from hypothesis import given, settings

from qnerf.quantum import QuantumLayer, density, pauli_errors
from qnerf.quantum.circuit import (
    ANSATZE,
    Circuit,
    Gate,
    Hamiltonian,
    Probabilities,
    Weights,
    encoding,
    entanglers,
    feature,
    rotations,
)
from qnerf.quantum.diagnostics import weights_of
from qnerf.quantum.hardware_conditions import conditions
from qnerf.quantum.noise import Noise
from qnerf.quantum.pennylane import apply, measurements
from qnerf.quantum.simulator import Simulator
from tests.helpers.circuits import any_circuits

MIXTURE = Noise(depolarizing=0.02, two_qubit=0.05, phase_damping=0.03, bit_flip=0.01)
RELAXATION = {"t1": 50e-6, "t2": 30e-6, "one_qubit_time": 1e-6, "two_qubit_time": 4e-6}
FEW = Circuit(
    "few", 2, features=2, weights=(Weights("w", (1,)),),
    operations=(Gate("CRX", (0, 1), (feature(0),)), Gate("T", (1,)), Gate("IsingXY", (1, 0), (feature(1),))),
    observables=(((0, "Z"), (1, "Y")), ((1, "Z"),), Probabilities((1, 0))),
)  # fmt: skip
QIREN, CNOT = ANSATZE.build("qiren", 3, 2), ANSATZE.build("cnot", 3, 2)
ANGLES = Weights("w", (2, 3, 3))
ENCODED_FIRST = Circuit(  # errors after the first gates reach no rotation that trains
    "first", 3,
    (encoding("X", (1.0, 1.0, 2.0)), entanglers("CNOT", ((0, 1), (2, 0))), rotations(ANGLES[0]),
     entanglers("CZ", ((1, 2),)), encoding("Y", (1.0,) * 3), entanglers("CNOT", ((1, 0),)), rotations(ANGLES[1])),
    (((0, "X"),), ((1, "Y"), (2, "Z"))), weights=(ANGLES,),
)  # fmt: skip
EVERYTHING = replace(
    CNOT,
    observables=(((0, "X"), (1, "X"), (2, "Z")), Hamiltonian((0.5, 1.0), (((0, "Z"),), ())), Probabilities((2, 0))),
)


def data(circuit, batch=3):
    """Inputs and flat weights."""
    generator = torch.Generator().manual_seed(1)
    x = torch.randn(batch, circuit.features or 0, generator=generator, dtype=torch.float64)
    return x, torch.randn(circuit.size, generator=generator, dtype=torch.float64)


def made(circuit, batch=40):
    torch.manual_seed(3)
    return QuantumLayer(circuit).double(), data(circuit, batch)[0]


def test_patterns_taken_together_are_the_density_matrix():
    x, weights = data(FEW)
    letters = np.array(list(product(range(4), repeat=5)))  # of the five spots: none, X, Y, Z
    rates = {size: MIXTURE.pauli_probabilities(size) for size in (1, 2)}
    table = [[1 - sum(rates[size]), *rates[size]] for size in pauli_errors.spots(FEW)]
    chances = np.prod([np.array(table[spot])[letters[:, spot]] for spot in range(5)], axis=0)
    assert chances.sum() == pytest.approx(1)
    errors = zip(np.isin(letters, [1, 2]), np.isin(letters, [2, 3]), strict=True)
    outputs = [Simulator(pauli_errors.with_errors(FEW, *pattern))(x, weights) for pattern in errors]
    mean = sum((chance * values for chance, values in zip(chances, outputs, strict=True)), torch.zeros(()))
    expected = density.evaluate(FEW, x, weights, MIXTURE, {})
    torch.testing.assert_close(mean, expected, rtol=0, atol=1e-12)
    assert (expected - Simulator(FEW)(x, weights)).abs().max() > 0.01


def test_sampled_noise_agrees_with_density_matrices_within_its_standard_error():
    for circuit, noise, batch in (
        (QIREN, Noise(depolarizing=0.02, two_qubit=0.05), 40),
        (ENCODED_FIRST, Noise(bit_flip=0.02, phase_damping=0.05, readout=0.03), 40),
        (EVERYTHING, replace(MIXTURE, readout=0.03), 30),
    ):
        layer, x = made(circuit, batch)
        with conditions(layer, noise=noise, method="density") as exact:
            expected = layer(x).detach()
        assert exact.standard_error == 0
        with conditions(layer, noise=noise, method="sampled", patterns=200) as sampled:
            off = layer(x).detach() - expected
        assert 0.001 < sampled.standard_error < 0.03
        assert off.square().mean().sqrt() < 2 * sampled.standard_error  # the outputs share the patterns
        assert (layer(x).detach() - expected).square().mean().sqrt() > 3 * sampled.standard_error


def test_standard_errors_are_the_spread_over_seeds_and_follow_the_seed():
    words = (((0, "Z"),), ((0, "Z"), (1, "Y")), ((2, "X"),))
    for circuit in (QIREN, replace(QIREN, observables=(Hamiltonian((1.0, -2.0, 0.5), words),))):
        layer, x = made(circuit, 20)
        runs, errors = [], []
        for seed in (*range(50), 0):
            with conditions(layer, noise=0.015, method="sampled", patterns=20, seed=seed) as measuring:
                runs.append(layer(x).detach())
            errors.append(measuring.standard_error)
        assert torch.equal(runs[0], runs[-1])
        spread = torch.stack(runs[:-1]).std(0).square().mean().sqrt()
        assert 0.8 < np.sqrt(np.square(errors).mean()) / spread < 1.25


def test_derivatives_with_sampled_noise_are_those_of_the_patterns():
    for circuit in (CNOT, EVERYTHING):
        layer = QuantumLayer(circuit).double()

        def noisy(x, weights, layer=layer):
            with conditions(layer, noise=0.05, method="sampled", patterns=2, gradients=True):
                return layer.evaluate(x, weights)

        x, weights = data(circuit, 1)
        assert torch.autograd.gradcheck(noisy, (x.requires_grad_(), weights.requires_grad_()))


@settings(max_examples=6)
@given(circuit=any_circuits)
def test_density_matrices_of_any_circuit_equal_default_mixed(circuit):
    noise = replace(MIXTURE, amplitude_damping=0.1)
    layer = QuantumLayer(circuit).double()
    x, _ = data(circuit, 2)
    with conditions(layer, noise=noise, method="density"):
        found = layer(x).detach()

    @qml.qnode(qml.device("default.mixed", wires=circuit.wires))
    def node(sample, weights):
        apply(circuit, sample, weights, noise)
        return measurements(circuit)

    expected = [np.hstack(node(sample, weights_of(layer).numpy())) for sample in x.numpy()]
    torch.testing.assert_close(found, torch.tensor(np.array(expected)), rtol=0, atol=1e-11)


def test_density_matrices_of_reuploading_circuits_equal_default_mixed():
    """Relaxation, rates of gates on two wires, and errors of the readout as well."""
    noise = Noise(depolarizing=0.01, two_qubit=0.04, bit_flip=0.02, **RELAXATION)
    for name, spectral in (("qiren", 1), ("cnot", 2), ("rx", 1)):
        layer, x = made(ANSATZE.build(name, 2, spectral), 90)  # more than the grid: the polynomial where there is one
        weights = weights_of(layer).numpy()

        # On NumPy arrays: with torch tensors PennyLane forms its channels in single precision.
        @qml.qnode(qml.device("default.mixed", wires=2))
        def node(sample, layer=layer, weights=weights):
            apply(layer.circuit, sample, weights, noise)
            for wire in range(2):
                qml.BitFlip(0.03, wires=wire)
            return measurements(layer.circuit)

        expected = torch.tensor(np.array([node(sample) for sample in x[:2].numpy()]))
        with conditions(layer, noise=replace(noise, readout=0.03), method="density"):
            assert (layer(x)[:2] - expected).abs().max() < 1e-12
            assert (layer(x[:2]) - expected).abs().max() < 1e-12


def test_thermal_relaxation_is_that_of_pennylane():
    channels = Noise(**RELAXATION).after(2)
    assert [name for name, _ in channels] == ["AmplitudeDamping", "PhaseDamping"]
    ours = rho = np.array([[0.3, 0.2 + 0.1j], [0.2 - 0.1j, 0.7]])
    for name, probability in channels:
        kraus = getattr(qml, name).compute_kraus_matrices(probability)
        ours = sum(k @ ours @ k.conj().T for k in kraus)
    kraus = qml.ThermalRelaxationError.compute_kraus_matrices(0.0, 50e-6, 30e-6, 4e-6)
    assert np.abs(ours - sum(k @ rho @ k.conj().T for k in kraus)).max() < 1e-12
    assert ours[1, 1] == pytest.approx(0.7 * exp(-4 / 50))


def test_pauli_twirl_keeps_the_diagonal_of_the_transfer_matrix():
    paulis = [np.array(m) for m in ([[0, 1], [1, 0]], [[0, -1j], [1j, 0]], [[1, 0], [0, -1]])]
    noise = Noise(depolarizing=0.1, amplitude_damping=0.2, phase_damping=0.3, bit_flip=0.05)
    mixed = noise.pauli_probabilities(1)
    for letter, pauli in enumerate(paulis):
        state = pauli
        for kraus in noise.kraus_operators(1):
            state = sum(k.numpy() @ state @ k.numpy().conj().T for k in kraus)
        assert 1 - 2 * (sum(mixed) - mixed[letter]) == pytest.approx(np.trace(pauli @ state).real / 2)


def test_noise_that_is_impossible_is_one_line():
    for fields, message in (
        ({"t1": 1.0, "t2": 3.0, "one_qubit_time": 1.0}, "t2 expects at most 2 t1 = 2, got 3"),
        ({"t1": 1.0}, "also expect one_qubit_time"),
        ({"readout": (0.1, 0.2)}, r"readout expects a probability in \[0, 1\], got \(0.1, 0.2\)"),
        ({"cross_talk": 0.1}, "unknown field 'cross_talk'; known: depolarizing"),
        ({"two_qubit": 2.0}, r"two_qubit expects a probability in \[0, 1\], got 2.0"),
        ({"t2": -1.0}, "t2 expects a time in seconds, got -1.0"),
        ({"t1": 0.0}, "t1 and t2 expect a time above 0"),
    ):
        with pytest.raises(ValueError, match=message):
            Noise.of(fields)


def test_layers_train_with_shots_whose_gradients_are_exact():
    layer, x = made(QIREN)
    measuring = QuantumLayer(3, 2, shots=50).double()
    measuring.load_state_dict(layer.state_dict())
    assert not torch.allclose(measuring(x), layer(x), atol=0.01)
    gradients = [torch.autograd.grad(model(x).sum(), model.weights1)[0] for model in (layer, measuring)]
    assert torch.allclose(*gradients, atol=1e-12)


def test_layers_train_with_noise_that_is_right_on_average():
    layer, x = made(CNOT)
    noisy = QuantumLayer(CNOT, noise={"depolarizing": 0.02, "readout": 0.05}, patterns=5).double()
    noisy.load_state_dict(layer.state_dict())
    with conditions(layer, noise=Noise(depolarizing=0.02, readout=0.05), method="density"):
        expected = layer(x).detach()
    torch.manual_seed(0)
    draws = torch.stack([noisy(x).detach() for _ in range(100)])
    error = draws.std(0).square().mean().sqrt() / 10
    assert (draws.mean(0) - expected).square().mean().sqrt() < 2 * error < 0.02
    noisy(x).sum().backward()
    assert noisy.weights1.grad.abs().max() > 0
    with conditions(noisy):
        assert torch.equal(noisy(x).detach(), layer(x).detach())  # exact again


def test_words_are_read_as_their_bit_strings_are():
    """A word is the parity of the bits that are read after its letters were turned to Z."""
    noise = Noise(readout=0.04)
    gates = (Gate("RX", (0,), (feature(0),)), Gate("CRY", (0, 1), (feature(1),)), Gate("CNOT", (1, 2)))
    words = Circuit("words", 3, operations=gates, observables=(((0, "Z"), (2, "Z")), ((2, "Z"),), ((1, "X"),)))
    tables = (Probabilities((0, 2)), Probabilities((1,)))
    turned = replace(words, operations=(*gates, Gate("H", (1,))), observables=tables)
    zeros = replace(turned, operations=(Gate("RX", (0,), (0.0,)),))
    x, found = data(words, 4)[0], []
    for circuit in (words, turned, zeros):
        layer = QuantumLayer(circuit)
        with conditions(layer, noise=noise):
            found.append(layer(x))
    word, bits, ground = found
    torch.testing.assert_close(word[:, 0], bits[:, 0] - bits[:, 1] - bits[:, 2] + bits[:, 3])
    torch.testing.assert_close(word[:, 1], bits[:, 0] - bits[:, 1] + bits[:, 2] - bits[:, 3])
    torch.testing.assert_close(word[:, 2], bits[:, 4] - bits[:, 5])
    torch.testing.assert_close(ground[0, :4], torch.tensor([0.96**2, 0.96 * 0.04, 0.96 * 0.04, 0.04**2]).double())
