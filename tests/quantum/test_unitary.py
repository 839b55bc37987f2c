"""Matrices of circuits, against the gates one by one, and those against `QuantumLayer`."""

import pytest
import torch

from qnerf.quantum import QuantumLayer
from qnerf.quantum.normal_form import z_eigenvalues
from qnerf.quantum.unitary import apply, blocks, layered


@pytest.mark.parametrize("entangler", ["CZ", "CNOT"])
@pytest.mark.parametrize("kinds", [1, 3])
@pytest.mark.parametrize("groups", [None, (1, 1, 1), (2, 1)])
def test_the_matrix_of_a_circuit_does_what_its_gates_do(entangler, kinds, groups):
    circuit = layered(3, 2, entangler=entangler, groups=groups)
    angles = torch.randn(2, 3, kinds, dtype=torch.float64, requires_grad=True)
    (matrix,) = blocks(circuit, angles)
    gates = apply(circuit, torch.eye(8, dtype=torch.complex128), angles).T
    torch.testing.assert_close(matrix.to(gates.dtype), gates)
    assert matrix.is_complex() == (kinds == 3)
    weights = torch.randn(8, 8, dtype=torch.float64)
    ours, theirs = (torch.autograd.grad((weights * m.real).sum(), angles)[0] for m in (matrix, gates))
    torch.testing.assert_close(ours, theirs)


def test_the_gates_do_what_the_quantum_layer_does():
    circuit = layered(3, 2, uploads=2)
    layer = QuantumLayer(circuit).double()
    x = torch.randn(5, 3, dtype=torch.float64)
    angles = torch.cat([layer.weights1.flatten(0, 1), layer.weights2])
    start = torch.zeros(5, 8, dtype=torch.complex128)
    start[:, 0] = 1
    signs = torch.from_numpy(z_eigenvalues(tuple(frozenset({wire}) for wire in range(3)), 3))
    values = apply(circuit, start, angles, x).abs().square() @ signs.T
    torch.testing.assert_close(values, layer(x))
