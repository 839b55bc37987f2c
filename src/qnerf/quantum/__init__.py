"""Circuits of qubits, evaluated exactly and in batches. `QuantumLayer` is the way in, `from_qnode` the one from PennyLane.

The files, in the order in which a circuit passes through them: `expressions`, `gates` and `circuit` (the description),
`pauli_form` (what is left after merging gates), `compiled.pauli_engine` and `pauli_statevector` (its engines, compiled
and plain). Data re-uploading circuits take a faster way: `initial_angles`,
`normal_form` (what is left after merging gates), `cones` (which inputs an output depends on), `cost_model` (which
engine), `compiled.engine` and `lightcone` (the two engines on the CPU), `statevector` (the plain PyTorch reference),
`density` and `measurement` (noise and shots), `pennylane` (other devices, and the reference of everything). `tapes`,
`qnode` and `pennylane_device` read PennyLane's tapes.
"""

from typing import Any

from qnerf.quantum import hardware_conditions
from qnerf.quantum.layer import QuantumLayer

hardware = hardware_conditions  # the earlier name

__all__ = ["QuantumLayer", "from_qnode", "hardware", "hardware_conditions"]


def __getattr__(name: str) -> Any:
    if name == "from_qnode":  # PennyLane is imported only for who asks
        from qnerf.quantum.qnode import from_qnode

        return from_qnode
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
