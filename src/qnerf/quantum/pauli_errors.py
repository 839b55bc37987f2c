"""Noise of re-uploading circuits by sampled Pauli errors: as fast as the exact engines, with a standard error.

A channel that mixes Pauli errors is a lottery: after each gate an X, Y or Z happens on the wire, or nothing. A
draw for all gates is a pattern, and the noisy expectation value is the mean over patterns. A Pauli error between two
gates is carried through the entanglers to the nearest trainable rotation and becomes part of its angles:

    Z Rot(phi, theta, omega) = Rot(phi, theta, omega + pi),    Y Rot(phi, theta, omega) = Rot(phi, theta + pi, -omega)

up to a phase, and likewise before the rotation with phi. So each pattern is the same circuit with other weights, and
the engines need not know of it. The share of runs without any error, P0, is counted exactly: only patterns with an
error are drawn, and the result is P0 exact + (1 - P0) mean. It has the derivatives of what was drawn.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from math import pi
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from qnerf.quantum.circuit import Circuit, Encoding, Entangler, Rotations
from qnerf.quantum.noise import Noise
from qnerf.quantum.normal_form import OMEGA, PHI, THETA

Exact = Callable[[Tensor, Tensor], Tensor]
"""Inputs (B, n) and stacked weights (rows, 3, n) -> outputs (B, outputs), without noise."""


Final = Callable[[Tensor], Tensor]
"""An affine function of outputs (B, outputs)."""


def evaluate(
    exact: Exact, circuit: Circuit, x: Tensor, weights: Tensor, noise: Noise, patterns: int,
    random: np.random.Generator, final: Final,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Outputs (B, outputs) with sampled gate errors, and the standard errors of final(outputs), NaN for one pattern.

    The circuit `folds`. All samples share the patterns, so that each pattern is one call of `exact`.
    """
    gates = _gates(circuit)
    assert gates is not None, "a circuit that folds"
    sizes = [2 if isinstance(gate.operation, Entangler) else 1 for gate in gates for _ in gate.wires]
    clean, x_errors, z_errors = draw(sizes, noise, patterns, random)
    folded = zip(*fold(circuit, x_errors, z_errors), strict=True)
    of_patterns = (
        exact(x, weights * torch.from_numpy(sign).to(weights) + torch.from_numpy(shift).to(weights))
        for sign, shift in folded
    )
    return mean_of(clean, exact(x, weights), of_patterns, final)


def mean_of(clean: float, without: Tensor, of_patterns: Iterable[Tensor], final: Final) -> tuple[Tensor, Tensor]:
    """The mean outputs of all runs, and the standard errors of final(outputs).

    clean: the share of runs without an error, whose outputs are `without`. of_patterns: outputs with drawn errors.
    """
    mean, count = torch.zeros_like(without), 0
    center = squares = torch.zeros_like(final(without).detach())
    for count, values in enumerate(of_patterns, start=1):
        mean = mean + (values - mean) / count
        out = final(values).detach()
        change = out - center
        center = center + change / count
        squares = squares + change * (out - center)
    if not count:
        return without, squares
    error = (1 - clean) * (squares / (count - 1) / count).sqrt() if count > 1 else squares * torch.nan
    return clean * without + (1 - clean) * mean, error


def draw(
    sizes: Sequence[int], noise: Noise, patterns: int, random: np.random.Generator
) -> tuple[float, np.ndarray, np.ndarray]:
    """The probability of no error at all, and patterns that have one.

    The patterns are two boolean arrays (patterns, spots), an X part and a Z part; both make a Y. The spots are the
    wires of each gate in the order in which the gates are applied, `sizes` the wires of the gate at each spot. There
    are no patterns where no error can happen.
    """
    rates = {size: noise.pauli_probabilities(size) for size in set(sizes)}
    probabilities = np.array([rates[size] for size in sizes]).reshape(-1, 3)
    total = probabilities.sum(1)
    clean_before = np.concatenate([[1.0], np.cumprod(1 - total)])
    clean = float(clean_before[-1])
    if clean == 1.0:
        return 1.0, np.zeros((0, len(total)), bool), np.zeros((0, len(total)), bool)
    first = random.choice(len(total), size=patterns, p=clean_before[:-1] * total / (1 - clean))
    spots = np.arange(len(total))
    happens = random.random((patterns, len(total))) < total
    happens = (happens & (spots > first[:, None])) | (spots == first[:, None])
    upper = np.cumsum(probabilities, 1) / np.where(total > 0, total, 1)[:, None]
    letter = random.random((patterns, len(total)))
    return clean, happens & (letter < upper[:, 1]), happens & (letter >= upper[:, 0])


def folds(circuit: Circuit) -> bool:
    """Whether the errors of a circuit can become part of its angles; `carried_errors` takes any other circuit."""
    return circuit.reuploading and _gates(circuit) is not None


class NoisyGate(NamedTuple):
    """Gates of one kind at the same time; an entangler is one pair."""

    operation: Rotations | Entangler | Encoding
    wires: tuple[int, ...]
    spots: slice
    backwards: bool
    """Whether errors after it go back to the last rotation rather than on to the next one."""


def fold(circuit: Circuit, x_errors: np.ndarray, z_errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signs and shifts (patterns, rows, 3, n) of the stacked weights: weights * signs + shifts has the errors in it.

    Errors go back to the last rotation. Where an encoding is in between, they go on to the next rotation.
    """
    patterns, n = len(x_errors), circuit.wires
    signs, shifts = np.ones((patterns, circuit.rows, 3, n)), np.zeros((patterns, circuit.rows, 3, n))
    x, z = np.zeros((patterns, n), bool), np.zeros((patterns, n), bool)  # the errors that are carried

    def add(gate: NoisyGate) -> None:
        x[:, gate.wires] ^= x_errors[:, gate.spots]
        z[:, gate.wires] ^= z_errors[:, gate.spots]

    def absorb(row: int, angle: int) -> None:
        signs[:, row, angle] = 1.0 - 2.0 * x
        shifts[:, row, angle] = pi * (x ^ z)
        shifts[:, row, THETA] += pi * x
        x[:], z[:] = False, False

    gates = _gates(circuit)
    assert gates is not None, "a circuit that folds"
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
    return signs, shifts


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
    """All gates in order; None if an error reaches no rotation, or a row of the weights is used twice."""
    rows = [operation.row for operation in circuit.operations if isinstance(operation, Rotations)]
    if len(set(rows)) < len(rows):
        return None
    gates: list[NoisyGate] = []
    backwards = waiting = False
    for operation in circuit.operations:
        assert isinstance(operation, (Rotations, Entangler, Encoding))  # of a re-uploading circuit
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
