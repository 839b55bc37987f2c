"""Sampled Pauli errors of re-uploading circuits, as other angles: the engines need not know of them.

A Pauli error between two gates is carried through the entanglers to the nearest trainable rotation and becomes part of
its angles:

    Z Rot(phi, theta, omega) = Rot(phi, theta, omega + pi),    Y Rot(phi, theta, omega) = Rot(phi, theta + pi, -omega)

up to a phase, and likewise before the rotation with phi. So a pattern of errors is the same circuit with other weights.
"""

from collections.abc import Callable, Iterator
from functools import lru_cache
from math import pi
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from qnerf.quantum.circuit import Circuit, Encoding, Entangler, Rotations
from qnerf.quantum.normal_form import OMEGA, PHI, THETA

Exact = Callable[[Tensor, Tensor], Tensor]
"""Inputs (B, features) and flat weights -> outputs (B, outputs), without noise."""


def of_patterns(
    exact: Exact, circuit: Circuit, x: Tensor, weights: Tensor, x_errors: np.ndarray, z_errors: np.ndarray
) -> Iterator[Tensor]:
    """Outputs (B, outputs) with each pattern of errors: boolean (patterns, spots), X part and Z part."""
    for sign, shift in zip(*fold(circuit, x_errors, z_errors), strict=True):
        yield exact(x, weights * torch.from_numpy(sign).to(weights) + torch.from_numpy(shift).to(weights))


def folds(circuit: Circuit) -> bool:
    """Whether the errors of a circuit can become part of its angles."""
    return _gates(circuit) is not None


def check_folds(circuit: Circuit) -> None:
    """ValueError unless errors in this circuit can be sampled."""
    if not folds(circuit):
        raise ValueError(
            f"noise: errors are sampled in re-uploading circuits with a trainable rotation beside each gate, which "
            f"circuit {circuit.name} is not; evaluate with conditions(..., method='density') or train a layer with "
            "method='pennylane' and device='default.mixed'"
        )


class NoisyGate(NamedTuple):
    """Gates of one kind at the same time; an entangler is one pair."""

    operation: Rotations | Entangler | Encoding
    wires: tuple[int, ...]
    spots: slice
    backwards: bool
    """Whether errors after it go back to the last rotation rather than on to the next one."""


def fold(circuit: Circuit, x_errors: np.ndarray, z_errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signs and shifts (patterns, P) of the flat weights: weights * signs + shifts has the errors in it.

    Errors go back to the last rotation. Where an encoding is in between, they go on to the next rotation.
    """
    patterns, n = len(x_errors), circuit.wires
    signs, shifts = np.ones((patterns, circuit.rows, n, 3)), np.zeros((patterns, circuit.rows, n, 3))
    x, z = np.zeros((patterns, n), bool), np.zeros((patterns, n), bool)  # the errors that are carried

    def add(gate: NoisyGate) -> None:
        x[:, gate.wires] ^= x_errors[:, gate.spots]
        z[:, gate.wires] ^= z_errors[:, gate.spots]

    def absorb(row: int, angle: int) -> None:
        signs[:, row, :, angle] = 1.0 - 2.0 * x
        shifts[:, row, :, angle] = pi * (x ^ z)
        shifts[:, row, :, THETA] += pi * x
        x[:], z[:] = False, False

    gates = _gates(circuit)
    assert gates is not None, "see check_folds"
    for gate in gates:
        if isinstance(gate.operation, Rotations):
            absorb(gate.operation.row, PHI)
        elif not gate.backwards:
            _carry(x, z, gate)
            add(gate)
    for gate in reversed(gates):
        if gate.backwards:
            add(gate)
            if isinstance(gate.operation, Rotations):
                absorb(gate.operation.row, OMEGA)
            else:
                _carry(x, z, gate)
    return signs.reshape(patterns, -1), shifts.reshape(patterns, -1)


def _carry(x: np.ndarray, z: np.ndarray, gate: NoisyGate) -> None:
    """Pauli errors before an entangler become those after it, and the other way round."""
    if isinstance(gate.operation, Entangler):
        a, b = gate.wires
        if gate.operation.gate == "CZ":
            z[:, a] ^= x[:, b]
            z[:, b] ^= x[:, a]
        else:
            x[:, b] ^= x[:, a]
            z[:, a] ^= z[:, b]


@lru_cache(maxsize=256)
def _gates(circuit: Circuit) -> tuple[NoisyGate, ...] | None:
    """All gates in order; None if an error reaches no rotation, a row of the weights is used twice, or a gate is no
    operation of re-uploading circuits.
    """
    rows = [operation.row for operation in circuit.operations if isinstance(operation, Rotations)]
    if len(set(rows)) < len(rows) or circuit.weights:
        return None
    gates: list[NoisyGate] = []
    backwards = waiting = False
    for operation in circuit.operations:
        if not isinstance(operation, (Rotations, Entangler, Encoding)):
            return None
        if isinstance(operation, Encoding):
            if waiting:
                break
            backwards, waiting = False, True
        elif isinstance(operation, Rotations):
            backwards, waiting = True, False
        else:
            waiting = waiting or not backwards
        everything = (tuple(range(circuit.wires)),)
        for wires in operation.pairs if isinstance(operation, Entangler) else everything:
            start = gates[-1].spots.stop if gates else 0
            gates.append(NoisyGate(operation, wires, slice(start, start + len(wires)), backwards))
    return None if waiting else tuple(gates)
