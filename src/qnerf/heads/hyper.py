"""Qubits that point in the view direction, and a circuit whose angles a small network makes for each sample."""

from collections.abc import Mapping
from itertools import count
from typing import Annotated, Any, Literal

import torch
from annotated_types import Interval
from torch import Tensor, nn

from qnerf.config.bounds import Count, Factor
from qnerf.heads.base import HEADS, Head
from qnerf.heads.registers import BlochRegister
from qnerf.quantum import QuantumLayer
from qnerf.quantum.circuit import Amplitudes, Circuit, Gate, feature, ring

DIRECTION = 3  # the first features of a colour head


def sampled(qubits: int, layers: int, entangled: bool) -> Circuit:
    """Amplitudes of one qubit, shared by all, then `layers` of RZ and RY on every wire and a ring of CNOT.

    Its features are the real and imaginary parts of the two amplitudes (4), then 2 qubits layers angles.
    """
    real, imaginary, angles = (feature(0), feature(1)), (feature(2), feature(3)), map(feature, count(4))
    operations: list[Amplitudes | Gate] = [Amplitudes((wire,), real, imaginary) for wire in range(qubits)]
    for _ in range(layers):
        operations += [Gate(name, (wire,), (next(angles),)) for wire in range(qubits) for name in ("RZ", "RY")]
        if entangled:
            operations += [Gate("CNOT", pair) for pair in ring(qubits, 1)]
    observables = tuple(((wire, "Z"),) for wire in range(qubits))
    return Circuit("hyper", qubits, tuple(operations), observables, 4 + 2 * qubits * layers)


@HEADS.register("hyper")
class HyperHead(Head):
    """A circuit on view directions, with angles that a network of one hidden layer makes of the other features.

        angles = V relu(W x + b) + c,   out = gain R <Z> + d

    After the per-Gaussian network of QuantumGS (arXiv:2602.05047). All weights are of classical layers.

    Args:
        in_dim, out_dim: features in, of which the first three are the direction, and values out.
        qubits: each starts in the state whose Bloch vector is the direction.
        layers: of the circuit: RZ and RY on every wire, and a ring of CNOT.
        hidden: ReLU units of the network.
        unitary: local leaves the CNOTs out.
        gain: factor on the measured values.

    >>> HyperHead(8, 3)(torch.ones(5, 8)).shape
    torch.Size([5, 3])
    """

    quantum = True

    @classmethod
    def label(cls, options: Mapping[str, Any]) -> str:
        """`hyper3q4L12`: qubits, layers, hidden units; then `-local`."""
        local = "-local" if options["unitary"] == "local" else ""
        return f"hyper{options['qubits']}q{options['layers']}L{options['hidden']}{local}"

    def __init__(
        self,
        in_dim: int,
        out_dim: int,
        *,
        qubits: Annotated[int, Interval(ge=1, le=10)] = 3,
        layers: Annotated[int, Interval(ge=1, le=64)] = 4,
        hidden: Count = 12,
        unitary: Literal["circuit", "local"] = "circuit",
        gain: Factor = 2.0,
    ) -> None:
        super().__init__()
        if in_dim <= DIRECTION:
            raise ValueError(f"hyper expects features beside the {DIRECTION} of a view direction, got {in_dim} in all")
        self.gain = gain
        self.direction = BlochRegister(DIRECTION, 1)
        self.circuit = QuantumLayer(sampled(qubits, layers, unitary == "circuit"))
        angles = nn.Linear(hidden, 2 * qubits * layers)
        nn.init.uniform_(angles.bias, 0, 2 * torch.pi)
        self.network = nn.Sequential(nn.Linear(in_dim - DIRECTION, hidden), nn.ReLU(), angles)
        self.readout = nn.Linear(qubits, out_dim)

    def forward(self, features: Tensor) -> Tensor:
        """(N, in_dim) -> (N, out_dim)."""
        qubit = self.direction(features[:, :DIRECTION])
        angles = self.network(features[:, DIRECTION:])
        out: Tensor = self.readout(self.gain * self.circuit(torch.cat([qubit.real, qubit.imag, angles], 1)))
        return out
