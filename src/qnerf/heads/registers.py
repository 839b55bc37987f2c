"""Registers of qubits whose amplitudes are computed from features."""

from collections.abc import Sequence
from functools import reduce
from typing import Literal

import torch
from torch import Tensor, nn

Encoding = Literal["normalised", "softmax", "none"]


class AmplitudeRegister(nn.Module):
    """Features (N, in_dim) -> normalised, real amplitudes (N, 2^qubits).

    v = W x + b, with a ReLU layer of `hidden` units before it where asked for.

        normalised:  a = v / |v|
        softmax:     a = sqrt(softmax(v))

    softmax is the Boltzmann distribution of the energies -v.

    Args:
        bias: standard deviation of b at the start; W starts by He's rule.
    """

    def __init__(self, in_dim: int, qubits: int, *, encoding: Encoding, bias: float, hidden: int) -> None:
        super().__init__()
        self.encoding = encoding
        self.qubits = qubits
        self.hidden = nn.Sequential(nn.Linear(in_dim, hidden), nn.ReLU()) if hidden else None
        self.linear = nn.Linear(hidden or in_dim, 2**qubits)
        for layer in self.modules():
            if isinstance(layer, nn.Linear) and not layer.weight.is_meta:
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
                nn.init.normal_(layer.bias, std=bias if layer is self.linear else 0.0)

    def inputs(self, features: Tensor) -> Tensor:
        """What the last linear map gets."""
        return features if self.hidden is None else self.hidden(features)

    def forward(self, features: Tensor) -> Tensor:
        values = self.linear(self.inputs(features))
        if self.encoding == "softmax":
            return (values.log_softmax(-1) / 2).exp()
        amplitudes: Tensor = values / values.norm(dim=-1, keepdim=True)
        return amplitudes


class BlochRegister(nn.Module):
    """Directions (N, 3), of any length -> the state (N, 2^qubits) whose qubits all point there on the Bloch sphere.

    A qubit with the Bloch vector (x, y, z) is (1 + z, x + i y) / norm. The values of k such qubits are polynomials of
    degree k in the direction, as spherical harmonics are.
    """

    is_complex = True

    def __init__(self, in_dim: int, qubits: int) -> None:
        super().__init__()
        if in_dim != 3:
            raise ValueError(f"branch=bloch expects directions of 3 coordinates, got {in_dim}")
        self.qubits = qubits

    def forward(self, directions: Tensor) -> Tensor:
        x, y, z = nn.functional.normalize(directions, dim=-1).unbind(-1)
        up, zero = z >= 0, torch.zeros_like(z)
        # Either form is the state up to a phase, and is exact in its own half of the sphere.
        first = torch.complex(torch.where(up, 1 + z, x), torch.where(up, zero, -y))
        second = torch.complex(torch.where(up, x, 1 - z), torch.where(up, y, zero))
        qubit = torch.stack([first, second], -1)
        qubit = qubit / torch.linalg.vector_norm(qubit, dim=-1, keepdim=True)
        return product([qubit] * self.qubits)


def product(states: Sequence[Tensor]) -> Tensor:
    """The tensor product (N, 2^(n_1 + n_2 + ...)) of states (N, 2^n_i); the first has the most significant wires."""
    return reduce(lambda left, right: (left[:, :, None] * right[:, None, :]).flatten(1), states)
