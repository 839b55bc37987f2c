"""Diagnostics of circuits against closed forms."""

from dataclasses import replace
from math import log, pi

import pennylane as qml
import pytest
import torch
from torch import nn

from qnerf.quantum import QuantumLayer
from qnerf.quantum import diagnostics as d
from qnerf.quantum.circuit import ANSATZE, Circuit, Gate, Weights, encoding, entanglers, feature, rotations
from qnerf.quantum.pennylane import apply
from tests.quantum.test_any_circuit import MIXED

W = Weights("w", (2, 3, 3))
IDLE = Circuit("idle", 2, (), (((0, "Z"),), ((1, "Z"),)))
ROT = Circuit("rot", 1, rotations(W[0][:1]), (((0, "Z"),),), weights=(Weights("w", (1, 1, 3)),))
PRODUCT = Circuit(
    "product", 3, (rotations(W[0]), encoding("X", (1.0,) * 3), rotations(W[1])), (((0, "Z"),),), weights=(W,)
)
GHZ = Circuit("ghz", 3, (encoding("Y", (1.0, 0.0, 0.0)), entanglers("CNOT", ((0, 1), (1, 2)))), (((0, "Z"),),))


def test_states_are_those_of_pennylane():
    without = tuple(gate for gate in MIXED.operations if getattr(gate, "name", "") != "IsingXY")  # it takes no batch
    for circuit in (ANSATZE.build("cnot", 3, 2), replace(MIXED, operations=without)):
        layer = QuantumLayer(circuit).double()
        x, weights = d.uniform_angles(3, circuit.features or 0), d.weights_of(layer)

        @qml.qnode(qml.device("default.qubit", wires=3))
        def node(circuit=circuit, x=x, weights=weights):
            apply(circuit, x, weights)
            return qml.state()

        ours, theirs = d.states(circuit, x, weights), torch.as_tensor(node())
        overlaps = [(state.conj() @ state.T).abs() for state in (ours, theirs)]
        torch.testing.assert_close(*overlaps, rtol=0, atol=1e-12)
        torch.testing.assert_close(d.meyer_wallach(ours), d.meyer_wallach(theirs), rtol=0, atol=1e-12)
        torch.testing.assert_close(d.states(circuit, x, weights.expand(3, -1)), ours, rtol=0, atol=1e-14)


def test_entanglement_of_product_and_ghz_states():
    product = d.entangling_capability(QuantumLayer(PRODUCT), states=20)
    assert product.mean == pytest.approx(0, abs=1e-12)
    quarter = torch.tensor([[pi / 2, 0.0, 0.0]])
    assert d.entangling_capability(QuantumLayer(GHZ), states=3, x=quarter).mean == pytest.approx(1)
    # cos(a/2) |000> + sin(a/2) |111>: every wire has purity 1 - sin(a)^2 / 2; the mean of sin^2 is 1/2.
    uniform = d.entangling_capability(QuantumLayer(GHZ), states=4000)
    assert abs(uniform.mean - 0.5) < 4 * uniform.standard_error < 0.03


def test_expressibility_of_an_idle_circuit_of_haar_states_and_of_one_rotation():
    assert d.expressibility(QuantumLayer(IDLE), pairs=10) == pytest.approx(log(75))
    noise = torch.randn(2, 20_000, 8, dtype=torch.complex128)
    haar = noise / noise.norm(dim=-1, keepdim=True)
    fidelity = (haar[0].conj() * haar[1]).sum(-1).abs().square()
    assert 0.5 < d._divergence(fidelity, 3) / (74 / 40_000) < 1.6
    # Rot with uniform angles: latitudes a, b and a difference c of longitudes are uniform angles.
    a, b, c = ((torch.arange(count, dtype=torch.float64) + 0.5) * (2 * pi / count) for count in (200, 211, 101))
    products = a.cos()[:, None] * b.cos(), a.sin()[:, None] * b.sin()
    expected = d._divergence((1 + products[0][..., None] + products[1][..., None] * c.cos()).flatten() / 2, 1)
    assert expected > 0.005
    assert d.expressibility(QuantumLayer(ROT), pairs=40_000) == pytest.approx(expected, abs=0.004)


def test_effective_dimension_counts_directions():
    k = 1000 / (2 * pi * log(1000))
    flat = torch.diag(torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=torch.float64))
    assert d.effective_dimension([flat], 1000) == pytest.approx(2 * log(1 + 2 * k) / log(k))
    assert d.effective_dimension([flat, flat], 10**300) == pytest.approx(2, abs=0.01)
    with pytest.raises(ValueError, match="more samples"):
        d.effective_dimension([flat], 10)


def test_tangent_kernel_of_a_linear_model_and_of_a_circuit():
    x = torch.randn(70, 3, dtype=torch.float64)
    linear = nn.Linear(3, 2).double()
    assert torch.allclose(d.tangent_kernel(linear, x), 2 * (x @ x.T + 1))
    layer = QuantumLayer(2, 1).double()
    kernel = d.tangent_kernel(layer, x[:2, :2])
    gradients = []
    for sample in x[:2, :2]:
        for output in layer(sample):
            one, two = torch.autograd.grad(output, (layer.weights1, layer.weights2), retain_graph=True)
            gradients.append(torch.cat([one.flatten(), two.flatten()]))
    jacobian = torch.stack(gradients).reshape(2, 2, -1)
    assert torch.allclose(kernel, torch.einsum("aop,bop->ab", jacobian, jacobian))


def test_surrogate_is_exact_where_it_covers_the_spectrum():
    layer = QuantumLayer(2, 2).double()
    fitted, tested = torch.randn(400, 2), torch.randn(200, 2)
    whole = d.surrogate(layer, fitted, tested, 13)  # (5^2 + 1) / 2
    assert (whole.waves, whole.covered) == (13, True)
    assert whole.error < 1e-6
    some = d.surrogate(layer, fitted, tested, 5)
    assert (some.waves, some.covered) == (5, False)
    assert 1e-3 < some.error < 1
    assert d.surrogate(QuantumLayer(2, 1), tested, tested, 1).error == pytest.approx(1, abs=0.05)  # the mean alone
    # Waves of the right spectrum: a circuit with other scales is not covered by them.
    ternary = d._encodings(ANSATZE.build("ternary", 1, 2))
    assert d._frequencies(ternary, 9)[0].flatten().tolist() == [0, 1, 2, 3, 4]


def test_diagnostics_take_any_circuit():
    """A GHZ state by H and CNOTs, CRY by a trainable scale times a feature, and a frozen scale."""
    w, scale = Weights("w", (2,)), Weights("scale", (1,), initial=2.0)
    gates = (Gate("H", (0,)), Gate("CNOT", (0, 1)), Gate("CNOT", (1, 2)), Gate("RX", (2,), (w[0] * 0.0,)))
    ghz = QuantumLayer(Circuit("ghz", 3, operations=gates, observables=(((0, "X"),),), weights=(w,)))
    found = d.entangling_capability(ghz, states=3)
    assert (found.mean, found.standard_error) == pytest.approx((1, 0), abs=1e-12)
    assert d.expressibility(ghz, pairs=10) == pytest.approx(log(75))  # always the same state
    turns = (Gate("RY", (0,), (scale[0] * feature(0),)), Gate("CNOT", (0, 1)), Gate("RY", (0,), (w[0],)),
             Gate("RZ", (1,), (w[1],)))  # fmt: skip
    layer = QuantumLayer(Circuit("own", 2, turns, (((0, "Z"),),), 1, (w, scale)))
    expected = torch.zeros(3, 3, dtype=torch.float64)
    expected[0, 0] = 1  # RY on wire 0 alone, at the input 0; RZ cannot be seen in the computational basis
    expected[2, 2] = 0  # the scale is multiplied by the input 0
    torch.testing.assert_close(d.fisher(layer, torch.zeros(2, 1)), expected, atol=1e-12, rtol=0)
    drawn = d.random_weights(layer, 50)
    assert (drawn[:, 2] == 2).all()
    assert drawn[:, :2].std() > 1
    x = torch.randn(60, 1)
    assert d.tangent_kernel(layer, x[:3]).shape == (3, 3)
    with pytest.raises(ValueError, match="surrogate expects a circuit whose spectrum is known, got own"):
        d.surrogate(layer, x, x, 3)
