"""Circuits of qubits, evaluated exactly and in batches: `QuantumLayer`, and `from_qnode` for circuits of PennyLane.

The files, in the order in which a circuit passes through them. The description: `expressions` (angles), `gates`,
`circuit` (what a circuit is, and circuits by name).

`simulator` runs a circuit: it takes the cheapest engine (`cost_model`), and splits wide circuits into `registers`.

`words` and `basis` (Pauli words and basis states as bits), `blocks` and `program` (what is left after merging gates),
`angles` (their values), `initial_angles`. `statevector` runs a program in plain PyTorch, `compiled.engine` on the CPU.
`cones` (which inputs an output depends on) and `lightcone` (polynomials of these inputs).

Hardware: `noise` (what goes wrong), `density` (exact), `pauli_errors` (sampled), `readout`, `measurement`.

PennyLane: `pennylane` runs circuits on its devices, and is the reference of everything. `tapes`, `qnode` and
`pennylane_device` bring its circuits here. `effects` names what of a circuit has no effect, `diagnostics` says what it
can express and how it learns.
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
