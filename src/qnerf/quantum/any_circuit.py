"""Any circuit of gates: the Pauli form, simulated as a state."""

from functools import cached_property

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


class AnyCircuit:
    """A circuit of any gates; see `families.Family`."""

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
        form = pauli_form(self.circuit)
        memory = work_bytes(form, batch, dtype.itemsize) if compiled else statevector.CHUNK_BYTES
        reason = f"{len(form.rotations)} rotations about Pauli words"
        return Cost("statevector", "compiled" if compiled else "torch", batch, operations(form), 0, memory, reason)

    def evaluate(self, x: Tensor, weights: Tensor, cost: Cost) -> Tensor:
        if cost.backend == "compiled":
            return self._engine.evaluate(x, weights)
        return self._engine.plain.evaluate(x, weights)

    def states(self, x: Tensor, weights: Tensor) -> Tensor:
        return gate_by_gate(self.circuit, x, weights)

    def bit_probabilities(self, x: Tensor, weights: Tensor) -> Tensor:
        state = self.states(x, weights)
        return state.real.square() + state.imag.square()


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
