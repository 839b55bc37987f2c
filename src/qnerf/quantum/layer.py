"""QuantumLayer: a batched re-uploading circuit as an nn.Module."""

import torch
from torch import Tensor, nn

from qnerf.quantum import statevector
from qnerf.quantum.circuit import ANSATZE, Circuit, check_wires
from qnerf.quantum.initial import INITS
from qnerf.quantum.program import compile_program

METHODS = ("auto", "lightcone", "statevector", "pennylane")


class QuantumLayer(nn.Module):
    """(..., wires) -> (..., wires)."""

    def __init__(
        self, wires: int, spectral: int, *, method: str = "auto", ansatz: str = "qiren", init: str = "uniform"
    ) -> None:
        super().__init__()
        check_wires(wires)
        if method not in METHODS:
            raise ValueError(f"method: unknown name {method!r}; known: {', '.join(METHODS)}")
        self.circuit: Circuit = ANSATZE.build(ansatz, wires, spectral)
        self.program = compile_program(self.circuit)
        self.method = method
        first, second = self.circuit.shapes
        angles = INITS.get(init)(self.circuit)
        self.weights1 = nn.Parameter(angles[: -second[0]].reshape(first))
        self.weights2 = nn.Parameter(angles[-second[0] :].reshape(second))

    def forward(self, x: Tensor) -> Tensor:
        if not x.is_floating_point():
            raise ValueError(f"QuantumLayer expects floating-point angles, got {x.dtype}")
        if x.ndim == 0 or x.shape[-1] != self.circuit.wires:
            raise ValueError(f"QuantumLayer expects (..., {self.circuit.wires}), got {tuple(x.shape)}")
        weights = statevector.stacked(self.weights1, self.weights2)
        flat = x.reshape(-1, self.circuit.wires).to(weights.dtype)
        return statevector.evaluate(self.program, flat, weights).reshape(*x.shape[:-1], -1)
