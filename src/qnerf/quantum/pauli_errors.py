"""Noise by sampled Pauli errors: as fast as the exact engines, with a standard error.

A channel that mixes Pauli errors is a lottery: after each gate an X, Y or Z happens on the wire, or nothing. A
draw for all gates is a pattern, and the noisy expectation value is the mean over patterns. The share of runs without
any error, P0, is counted exactly: only patterns with an error are drawn, and the result is P0 exact + (1 - P0) mean.
It has the derivatives of what was drawn.

Each pattern is the same circuit with other weights; the engines need not know of errors. An error between two gates is
carried through the entanglers to the nearest trainable rotation and becomes part of its angles:

    Z Rot(phi, theta, omega) = Rot(phi, theta, omega + pi),    Y Rot(phi, theta, omega) = Rot(phi, theta + pi, -omega)

up to a phase, and likewise before the rotation with phi.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from math import pi
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from qnerf.quantum.circuit import Circuit, Encoding, Entangler, Rotations
from qnerf.quantum.noise import Noise
from qnerf.quantum.normal_form import OMEGA, PHI, THETA
from qnerf.quantum.pauli_form import only_gates

Exact = Callable[[Tensor, Tensor], Tensor]
"""Inputs (B, features) and flat weights -> outputs (B, outputs), without noise."""

Final = Callable[[Tensor], Tensor]
"""An affine function of outputs (B, outputs)."""


def evaluate(
    exact: Exact, circuit: Circuit, x: Tensor, weights: Tensor, noise: Noise, patterns: int,
    random: np.random.Generator, final: Final,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Outputs (B, outputs) with sampled gate errors, and the standard errors of final(outputs), NaN for one pattern.

    Args:
        exact: the outputs without noise.
        circuit: measures Pauli words and `Probabilities`, no Hamiltonians.
        x: (B, features).
        weights: flat.
        noise: mixed or twirled to Pauli errors; see `Noise.pauli_probabilities`.
        patterns: drawn; all samples share them.
        random: their source.
        final: an affine function of the outputs.

    Raises:
        ValueError: a circuit whose errors cannot be sampled.
    """
    check_folds(circuit)
    clean, *errors = draw(spots(circuit), noise, patterns, random)
    return mean_of(clean, exact(x, weights), of_patterns(exact, circuit, x, weights, *errors), final)


def spots(circuit: Circuit) -> list[int]:
    """Where errors can happen: the wires of each gate, in order. Each is given by the number of wires of its gate."""
    return [len(gate.wires) for gate in only_gates(circuit) for _ in gate.wires]


def mean_of(clean: float, without: Tensor, drawn: Iterable[Tensor], final: Final) -> tuple[Tensor, Tensor]:
    """The mean outputs of all runs, and the standard errors of final(outputs).

    clean: the share of runs without an error, whose outputs are `without`. drawn: outputs with drawn errors.
    """
    mean, count = torch.zeros_like(without), 0
    center = squares = torch.zeros_like(final(without).detach())
    for count, values in enumerate(drawn, start=1):
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

    The patterns are two boolean arrays (patterns, spots), an X part and a Z part; both make a Y. `sizes` are
    the `spots`. There are no patterns where no error can happen.
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
            f"circuit {circuit.name} is not; evaluate with conditions(..., method='density') or train it on PennyLane's"
            " default.mixed (docs/hardware.md)"
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
