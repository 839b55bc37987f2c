"""The unitaries of an amplitude head: a circuit, and the controls that show what the circuit is worth."""

from typing import Literal

import torch
from torch import Tensor, nn

from qnerf.quantum.circuit import Circuit
from qnerf.quantum.unitary import blocks, layered

Kind = Literal["circuit", "local", "identity", "dense", "random"]


class Unitaries(nn.Module):
    """The matrices before, between and after the encodings of a circuit of n wires: `count` of (2^n, 2^n).

    Args:
        kind: where the matrices come from.
            `circuit`: layers of a rotation on every wire and a ring of CZ, with trained angles;
            `local`: the same without entanglers;
            `identity`: the identity;
            `dense`: any rotation, trained as exp(A - A^T), or any unitary, as exp(A - A^T + i (A + A^T));
            `random`: one drawn by Haar's measure at the start and kept.
        rotations: RY, which is real, or Rot, which is complex.
    """

    fixed: Tensor

    def __init__(self, wires: int, count: int, *, kind: Kind, layers: int, rotations: str) -> None:
        super().__init__()
        self.kind = kind
        self.count = count
        self.is_complex = rotations == "Rot"
        self.layers, self.entangled = layers, kind != "local"
        self.circuit: Circuit = layered(wires, layers, uploads=count - 1, entangled=self.entangled)
        size = 2**wires
        if kind in ("circuit", "local"):
            self.angles = nn.Parameter(torch.rand(count * layers, wires, 3 if self.is_complex else 1) * (2 * torch.pi))
        elif kind == "dense":
            self.generator = nn.Parameter(torch.randn(count, size, size) / size**0.5)
        elif kind == "random":
            parts = torch.randn(2 if self.is_complex else 1, count, size, size)
            q, r = torch.linalg.qr(torch.complex(*parts) if self.is_complex else parts[0])
            q = q * r.diagonal(dim1=-2, dim2=-1).sgn()[:, None, :]
            self.register_buffer("fixed", torch.stack([q.real, q.imag]) if self.is_complex else q)

    def forward(self) -> list[Tensor | None]:
        """The matrices; None stands for the identity."""
        if self.kind == "identity":
            return [None] * self.count
        if self.kind == "random":
            return list(torch.complex(*self.fixed) if self.is_complex else self.fixed)
        if self.kind == "dense":
            a, t = self.generator, self.generator.mT
            return list(torch.matrix_exp(torch.complex(a - t, a + t) if self.is_complex else a - t))
        return list(blocks(self.angles, self.layers, self.entangled))
