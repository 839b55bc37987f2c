"""Matrices of circuits, against those of PennyLane."""

from itertools import product

import pennylane as qml
import torch

from qnerf.quantum.pennylane import apply
from qnerf.quantum.unitary import blocks, layered


def test_blocks_are_the_matrices_that_pennylane_has() -> None:
    for kinds, entangled in product((1, 3), (True, False)):
        circuit = layered(3, 2, entangled=entangled)
        angles = torch.randn(2, 3, kinds, dtype=torch.float64, requires_grad=True)
        (matrix,) = blocks(angles, 2, entangled)
        weights = angles if kinds == 3 else torch.nn.functional.pad(angles, (1, 1))
        with qml.tape.QuantumTape() as tape:
            apply(circuit, torch.zeros(3, dtype=torch.float64), weights.flatten())
        expected = qml.matrix(tape, wire_order=range(3))
        torch.testing.assert_close(matrix.to(expected.dtype), expected)
        assert matrix.is_complex() == (kinds == 3)
        factors = torch.randn(8, 8, dtype=torch.float64)
        ours, theirs = (torch.autograd.grad((factors * m.real).sum(), angles)[0] for m in (matrix, expected))
        torch.testing.assert_close(ours, theirs)
