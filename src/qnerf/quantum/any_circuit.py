"""Any circuit of gates: the Pauli form, simulated as a state."""

from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from qnerf.kernels.jit import loop_threads
from qnerf.kernels.simd import VECTOR_BYTES
from qnerf.quantum import statevector
from qnerf.quantum.circuit import Circuit
from qnerf.quantum.compiled.pauli_engine import PauliEngine
from qnerf.quantum.cones import find_cones
from qnerf.quantum.cost_model import Cost
from qnerf.quantum.pauli_form import PauliForm, pauli_form
from qnerf.quantum.pauli_statevector import PauliCircuit, gate_by_gate
from qnerf.quantum.registers import Register, as_registers, gate_registers, is_split, measured


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
        return work_bytes(pauli_form(self.circuit), 1)

    def cost(self, batch: int, dtype: torch.dtype, compiled: bool) -> Cost:
        split = is_split(self.circuit)
        circuits = [part.circuit for part in self.registers()] if split else [self.circuit]
        forms = [pauli_form(circuit) for circuit in circuits]
        itemsize = torch.finfo(dtype).bits // 8
        memory = max(work_bytes(form, batch, itemsize) for form in forms) if compiled else statevector.CHUNK_BYTES
        if split:
            memory += 2 * batch * measured(self.circuit).values * itemsize
        reason = as_registers(self.circuit) if split else f"{len(forms[0].rotations)} rotations about Pauli words"
        backend = "compiled" if compiled else "torch"
        return Cost("statevector", backend, batch, sum(map(operations, forms)), 0, memory, reason)

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


def operations(form: PauliForm) -> int:
    """Multiply-adds for each sample, forward and backward."""
    moving = len(form.rotations) - form.fixed_rotations
    return 2**form.wires * (19 * moving + 7 * len(form.words) + 8 * len(form.tables))


def work_bytes(form: PauliForm, batch: int, itemsize: int = 4) -> int:
    """Bytes of work space, at most: three states of a block of samples for each thread, angles, starts."""
    blocks = -(-batch * itemsize // VECTOR_BYTES)
    states = 6 * min(loop_threads(), blocks) + (5 * blocks if form.start else 0)
    values = len(form.words) + form.outcomes + 6 * len(form.rotations)
    parts = 2 * 8 * min(32, blocks) * 2**form.wires
    return (states * 2**form.wires + blocks * values) * VECTOR_BYTES + parts
