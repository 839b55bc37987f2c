"""Any circuit of gates: the Pauli form, simulated as a state."""

from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from qnerf.quantum import pauli_cost
from qnerf.quantum.circuit import Circuit
from qnerf.quantum.compiled.pauli_engine import PauliEngine
from qnerf.quantum.cones import find_cones
from qnerf.quantum.cost_model import Cost, of_registers
from qnerf.quantum.pauli_form import pauli_form
from qnerf.quantum.pauli_statevector import PauliCircuit, gate_by_gate
from qnerf.quantum.registers import Register, gate_registers, is_split


class AnyCircuit:
    """A circuit of any gates; see `families.Family`."""

    reads_all_wires = False

    def __init__(self, circuit: Circuit, method: str = "auto") -> None:
        self.circuit = circuit
        if method == "lightcone":
            find_cones(circuit)  # its error says that only re-uploading circuits have cones

    @cached_property
    def _engine(self) -> PauliEngine:
        return PauliEngine(PauliCircuit(self.circuit))

    def sample_bytes(self) -> int:
        return pauli_cost.memory_bytes(pauli_form(self.circuit), 1)

    def cost(self, batch: int, dtype: torch.dtype, compiled: bool) -> Cost:
        if not is_split(self.circuit):
            return pauli_cost.cost(pauli_form(self.circuit), batch, dtype, compiled)
        parts = [pauli_cost.cost(pauli_form(part.circuit), batch, dtype, compiled) for part in self.registers()]
        return of_registers(parts, self.circuit, dtype)

    def registers(self) -> tuple[Register, ...]:
        return gate_registers(self.circuit)

    def evaluate(self, x: Tensor, weights: Tensor, cost: Cost) -> Tensor:
        if cost.backend == "compiled":
            return self._engine.evaluate(x, weights)
        return self._engine.plain.evaluate(x, weights)

    def states(self, x: Tensor, weights: Tensor) -> Tensor:
        return gate_by_gate(self.circuit, x, weights)

    def bit_probabilities(self, x: Tensor, weights: Tensor) -> Tensor:
        state = self.states(x, weights)
        return state.real.square() + state.imag.square()

    def bit_signs(self) -> np.ndarray:
        raise NotImplementedError("its outputs are read one by one")
