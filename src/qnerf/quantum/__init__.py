"""Circuits of qubits, evaluated exactly and in batches: `QuantumLayer`, and `from_qnode` for circuits of PennyLane.

The files, in the order in which a circuit passes through them. The description: `expressions` (angles), `gates`,
`circuit` (what a circuit is, and circuits by name).

`simulator` runs a circuit: it takes the cheapest engine, and splits wide re-uploading circuits into `registers`. What
differs between the two families of circuits is in `families`; either takes its weights flat.

Data re-uploading circuits (`reuploading`): `initial_angles`, `normal_form` (what is left after merging gates), `cones`
(which inputs an output depends on), `cost_model` (which engine), `compiled.engine` and `lightcone` (the two engines on
the CPU), `statevector` (the plain PyTorch reference).

Any other circuit (`any_circuit`): `pauli_form` (what is left after merging gates), `compiled.pauli_engine` and
`pauli_statevector` (the engine and its reference).

Hardware: `noise` (what goes wrong), `density` (exact), `pauli_errors` (sampled), `readout`, `measurement`.

PennyLane: `pennylane` runs circuits on its devices, and is the reference of everything. `tapes`, `qnode` and
`pennylane_device` bring its circuits here. `diagnostics` says what a circuit can express and how it learns.
"""

from typing import Any

from qnerf.quantum import hardware_conditions
from qnerf.quantum.layer import QuantumLayer

__all__ = ["QuantumLayer", "from_qnode", "hardware_conditions"]


def __getattr__(name: str) -> Any:
    if name == "from_qnode":  # PennyLane is imported only for who asks
        from qnerf.quantum.qnode import from_qnode

        return from_qnode
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
