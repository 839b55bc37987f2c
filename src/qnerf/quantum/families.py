"""The two families of circuits, and everything that they do differently.

Data re-uploading circuits (`reuploading`) have a normal form, light cones and the fastest engines. Any other circuit
(`any_circuit`) has a Pauli form. Either takes its weights flat, in the order of `Circuit.parameters`.
"""

from typing import Protocol

import torch
from torch import Tensor

from qnerf.quantum.any_circuit import AnyCircuit
from qnerf.quantum.circuit import Circuit
from qnerf.quantum.cost_model import Cost
from qnerf.quantum.reuploading import Reuploading


class Family(Protocol):
    """A circuit as its family runs it; `Family(circuit, method)` with a method of `Simulator`.

    Raises:
        TooLarge: method=lightcone for a circuit without small light cones.
    """

    def sample_bytes(self) -> int:
        """Bytes of work space for one sample, as one state of all wires."""

    def cost(self, batch: int, dtype: torch.dtype, compiled: bool) -> Cost:
        """The engine for a batch, and what a step costs."""

    def evaluate(self, x: Tensor, weights: Tensor, cost: Cost) -> Tensor:
        """Outputs (B, outputs) for inputs x (B, features) and flat weights, by the engine that `cost` names."""

    def states(self, x: Tensor, weights: Tensor) -> Tensor:
        """The states (B, 2^n) at the end, complex128, up to a phase and to one rotation of all wires."""

    def bit_probabilities(self, x: Tensor, weights: Tensor) -> Tensor:
        """Probabilities (B, 2^n) of the bit strings that are read: of a re-uploading circuit in the basis that it
        measures each wire in, of any other in the computational basis."""


def family_of(circuit: Circuit, method: str = "auto") -> Family:
    """The circuit as its family runs it."""
    return Reuploading(circuit, method) if circuit.reuploading else AnyCircuit(circuit, method)
