"""Noise of any described circuit: carried errors against gates, sums over all patterns against density matrices."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from qnerf.quantum import QuantumLayer, carried_errors, density, from_qnode
from qnerf.quantum.circuit import Circuit, Encoding, Gate, Hamiltonian, Probabilities, Rotations, Weights, feature
from qnerf.quantum.hardware_conditions import conditions
from qnerf.quantum.noise import Noise
from qnerf.quantum.registers import measured
from tests.quantum.test_any_circuit import MIXED, circuits

MIXTURE = Noise(depolarizing=0.02, two_qubit=0.05, phase_damping=0.03, bit_flip=0.01)
FEW = Circuit(
    "few", 2, features=2, weights=(Weights("w", (1,)),),
    operations=(Gate("CRX", (0, 1), (feature(0),)), Gate("T", (1,)), Gate("IsingXY", (1, 0), (feature(1),))),
    observables=(((0, "Z"), (1, "Y")), ((1, "Z"),), Probabilities((1, 0))),
)  # fmt: skip
EVERYTHING = replace(MIXED, observables=(*MIXED.observables, ((0, "X"), (1, "X"), (2, "Z"))))


def values_of(circuit: Circuit) -> Circuit:
    """The circuit without Hamiltonians."""
    return replace(circuit, observables=measured(circuit).observables or ((),))


def data(circuit: Circuit, batch: int = 3) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    size = sum(weights.size for weights in circuit.weights)
    x = torch.randn(batch, circuit.features or 0, generator=generator, dtype=torch.float64)
    return x, torch.randn(size, generator=generator, dtype=torch.float64)


@settings(max_examples=25)
@given(circuit=circuits(), seed=st.integers(0, 99))
def test_carried_errors_are_gates_after_the_gates(circuit: Circuit, seed: int) -> None:
    circuit = values_of(circuit)
    x, weights = data(circuit)
    spots = sum(len(gate.wires) for gate in carried_errors.noisy_gates(circuit))
    x_errors, z_errors = np.random.default_rng(seed).random((2, 2, spots)) < 0.3
    outputs = list(carried_errors.of_patterns(circuit, x, weights, x_errors, z_errors))
    for pattern in range(2):
        (alone,) = carried_errors.of_patterns(
            circuit, x, weights, x_errors[pattern : pattern + 1], z_errors[pattern : pattern + 1]
        )
        operations, spot = [], 0
        for operation in circuit.operations:
            operations.append(operation)
            for wire in operation.wires if isinstance(operation, Gate) else ():
                operations += [Gate("X", (wire,))] * int(x_errors[pattern, spot])
                operations += [Gate("Z", (wire,))] * int(z_errors[pattern, spot])
                spot += 1
        layer = QuantumLayer(replace(circuit, operations=tuple(operations))).double()
        expected = layer.evaluate(x, weights)
        for found in (outputs[pattern], alone):  # many patterns in a call, and one
            torch.testing.assert_close(found, expected, rtol=0, atol=1e-11)


def test_all_patterns_together_are_the_density_matrix() -> None:
    x, weights = data(FEW)
    letters = np.array(list(product(range(4), repeat=5)))  # of the five spots: none, X, Y, Z
    rates = {size: MIXTURE.pauli_probabilities(size) for size in (1, 2)}
    table = [[1 - sum(rates[size]), *rates[size]] for size in (2, 2, 1, 2, 2)]
    chances = np.prod([np.array(table[spot])[letters[:, spot]] for spot in range(5)], axis=0)
    assert chances.sum() == pytest.approx(1)
    outputs = carried_errors.of_patterns(FEW, x, weights, np.isin(letters, [1, 2]), np.isin(letters, [2, 3]))
    mean = sum((chance * values for chance, values in zip(chances, outputs, strict=True)), torch.zeros(()))
    expected = density.evaluate(FEW, x, weights, MIXTURE, {})
    torch.testing.assert_close(mean, expected, rtol=0, atol=1e-12)
    assert (expected - QuantumLayer(FEW).double().evaluate(x, weights)).abs().max() > 0.01


@settings(max_examples=6)
@given(circuit=circuits())
def test_density_matrices_equal_default_mixed(circuit: Circuit) -> None:
    noise = replace(MIXTURE, amplitude_damping=0.1)
    layer = QuantumLayer(circuit).double()
    peer = QuantumLayer(circuit, method="pennylane", device="default.mixed", noise=noise).double()
    peer.load_state_dict(layer.state_dict())
    x, _ = data(circuit, 2)
    with conditions(layer, noise=noise, method="density"):
        found = layer(x)
    torch.testing.assert_close(found.detach(), peer(x).detach(), rtol=0, atol=1e-7)  # its channels are float32


@pytest.mark.parametrize("batch", [40, 300])  # many patterns in a call, and one
def test_sampled_errors_agree_with_density_matrices_within_their_standard_error(batch: int) -> None:
    layer = QuantumLayer(EVERYTHING).double()
    x, _ = data(EVERYTHING, batch)
    noise = replace(MIXTURE, readout=0.02)
    with conditions(layer, noise=noise, method="density") as exact:
        expected = layer(x).detach()
    assert exact.standard_error == 0
    with conditions(layer, noise=noise, method="sampled", patterns=400) as sampled:
        off = layer(x).detach() - expected
    assert 0.001 < sampled.standard_error < 0.02
    assert off.square().mean().sqrt() < 2 * sampled.standard_error
    assert (layer(x).detach() - expected).square().mean().sqrt() > 3 * sampled.standard_error


def test_the_standard_error_of_a_hamiltonian_is_its_spread_over_seeds() -> None:
    words = (((0, "Z"),), ((0, "Z"), (1, "Y")), ((2, "X"),))
    layer = QuantumLayer(replace(MIXED, observables=(Hamiltonian((1.0, -2.0, 0.5), words),))).double()
    x, _ = data(MIXED, 20)
    runs, errors = [], []
    for seed in range(60):
        with conditions(layer, noise=0.02, method="sampled", patterns=20, seed=seed) as measured:
            runs.append(layer(x).detach())
        errors.append(measured.standard_error)
    spread = torch.stack(runs).std(0).square().mean().sqrt()
    assert 0.8 < np.sqrt(np.square(errors).mean()) / spread < 1.25


def test_derivatives_are_those_of_the_patterns_and_a_layer_trains() -> None:
    layer = QuantumLayer(MIXED).double()
    x, weights = data(MIXED, 2)

    def measured(x: Tensor, weights: Tensor) -> Tensor:
        with conditions(layer, noise=0.05, method="sampled", patterns=2, gradients=True):
            return layer.evaluate(x, weights)

    assert torch.autograd.gradcheck(measured, (x.requires_grad_(), weights.requires_grad_()))
    noisy = QuantumLayer(MIXED, noise={"two_qubit": 0.1, "readout": 0.02}, shots=100, patterns=3)
    noisy(x.float()).square().sum().backward()
    assert noisy.w.grad is not None
    assert noisy.w.grad.abs().max() > 0


def test_words_are_read_as_their_bit_strings_are() -> None:
    """A word is the parity of the bits that are read after its letters were turned to Z."""
    noise = Noise(depolarizing=0.02, readout=(0.04, 0.1))
    gates = [Gate("RX", (0,), (feature(0),)), Gate("CRY", (0, 1), (feature(1),)), Gate("CNOT", (1, 2))]
    words = Circuit("words", 3, operations=tuple(gates), observables=(((0, "Z"), (2, "Z")), ((2, "Z"),), ((1, "X"),)))
    turned = replace(
        words, operations=(*gates, Gate("H", (1,))), observables=(Probabilities((0, 2)), Probabilities((1,)))
    )
    x, _ = data(words, 4)
    found = []
    for circuit in (words, turned):
        layer = QuantumLayer(circuit)
        with conditions(layer, noise=replace(noise, depolarizing=0.0)):
            found.append(layer(x))
    word, bits = found
    torch.testing.assert_close(word[:, 0], bits[:, 0] - bits[:, 1] - bits[:, 2] + bits[:, 3])
    torch.testing.assert_close(word[:, 1], bits[:, 0] - bits[:, 1] + bits[:, 2] - bits[:, 3])
    torch.testing.assert_close(word[:, 2], bits[:, 4] - bits[:, 5])
    zeros = QuantumLayer(replace(turned, operations=(Gate("RX", (0,), (0.0,)),)))
    with conditions(zeros, noise=replace(noise, depolarizing=0.0)):
        torch.testing.assert_close(zeros(x)[0, :4], torch.tensor([0.96**2, 0.96 * 0.04, 0.96 * 0.04, 0.04**2]).double())
    long = tuple((wire, "Z") for wire in range(11))
    wide = QuantumLayer(Circuit("wide", 11, operations=(Gate("H", (0,)),), observables=(long,)))
    with conditions(wide, noise=noise), pytest.raises(ValueError, match="at most 10 letters, got one of 11"):
        wide(torch.zeros(1, 11))


def test_a_reuploading_circuit_whose_errors_do_not_fold_is_sampled_too() -> None:
    operations = Encoding("X", (1.0, 2.0)), Rotations(0), Rotations(0), Encoding("Y", (1.0, 1.0))
    twice = Circuit("twice", 2, 2, 1, operations, (((0, "Z"), (1, "Z")), ((1, "Z"),)))
    layer = QuantumLayer(twice).double()
    x = torch.randn(30, 2, dtype=torch.float64)
    for readout in (0.03, (0.01, 0.05)):
        noise = Noise(depolarizing=0.02, readout=readout)
        with conditions(layer, noise=noise, method="density"):
            expected = layer(x).detach()
        with conditions(layer, noise=noise, method="sampled", patterns=500) as measured:
            assert (layer(x).detach() - expected).square().mean().sqrt() < 2 * measured.standard_error < 0.02


def test_wide_circuits_are_sampled_in_registers() -> None:
    w = Weights("w", (40,))
    gates = [Gate("RY", (wire,), (w[wire] + feature(0),)) for wire in range(40)]
    gates += [Gate("CZ", (wire, wire + 1)) for wire in range(39)]
    wide = Circuit("wide", 40, features=1, weights=(w,), operations=tuple(gates), observables=(((7, "X"),),))
    own = Circuit("own", 3, features=1, weights=(Weights("w", (3,)),), observables=(((1, "X"),),), operations=(
        *(Gate("RY", (k,), (Weights("w", (3,))[k] + feature(0),)) for k in range(3)),
        Gate("CZ", (0, 1)), Gate("CZ", (1, 2))))  # fmt: skip
    x, weights = data(wide, 4)
    noise = Noise(depolarizing=0.01)
    expected = density.evaluate(own, x, weights[6:9], noise, {})
    layer = QuantumLayer(wide)
    with conditions(layer, noise=noise, patterns=2000) as measured:
        off = layer.evaluate(x, weights) - expected
    assert off.abs().max() < 4 * measured.standard_error < 0.05


def test_a_qnode_with_noise() -> None:
    import pennylane as qml

    @qml.qnode(qml.device("default.qubit", wires=2))
    def qnode(inputs: Tensor, weights: Tensor) -> list[object]:
        qml.AngleEmbedding(inputs, wires=range(2))
        qml.BasicEntanglerLayers(weights, wires=range(2))
        return [qml.expval(qml.Z(0)), qml.expval(qml.Z(0) @ qml.Z(1))]

    layer = from_qnode(qnode, {"weights": (2, 2)})
    noisy = QuantumLayer(layer.circuit(2), noise=0.01, patterns=200, seed=0)
    noisy.load_state_dict(layer.state_dict())
    x = torch.rand(5, 2)
    assert 1e-4 < (noisy(x) - layer(x)).abs().max() < 0.3
