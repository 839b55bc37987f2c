"""Matrices of circuits, against those of PennyLane."""

from itertools import product

import pennylane as qml
import torch

from qnerf.quantum.pennylane import apply
from qnerf.quantum.unitary import blocks, layered


def test_blocks_are_the_matrices_that_pennylane_has() -> None:
    for entangler, kinds, groups in product(("CZ", "CNOT"), (1, 3), (None, (1, 1, 1), (2, 1))):
        circuit = layered(3, 2, entangler=entangler, groups=groups)
        angles = torch.randn(2, 3, kinds, dtype=torch.float64, requires_grad=True)
        (matrix,) = blocks(circuit, angles)
        weights = torch.zeros(circuit.rows, 3, 3, dtype=torch.float64)
        weights[:2] = angles if kinds == 3 else torch.nn.functional.pad(angles, (1, 1))
        with qml.tape.QuantumTape() as tape:
            apply(circuit, torch.zeros(3, dtype=torch.float64), weights.flatten())
        expected = qml.matrix(tape, wire_order=range(3))
        torch.testing.assert_close(matrix.to(expected.dtype), expected)
        assert matrix.is_complex() == (kinds == 3)
        factors = torch.randn(8, 8, dtype=torch.float64)
        ours, theirs = (torch.autograd.grad((factors * m.real).sum(), angles)[0] for m in (matrix, expected))
        torch.testing.assert_close(ours, theirs)


def test_blocks_of_groups_of_wires_are_circuits_of_their_own() -> None:
    angles = torch.randn(2, 3, 1, dtype=torch.float64)
    (whole,) = blocks(layered(3, 2, groups=(2, 1)), angles)
    (first,), (second,) = blocks(layered(2, 2), angles[:, :2]), blocks(layered(1, 2), angles[:, 2:])
    torch.testing.assert_close(whole, torch.kron(first, second))
