"""Sampled Pauli errors in any circuit: a pattern of errors is the same circuit with other signs.

Every gate is a product of rotations exp(-i a/2 P) about Pauli words (`gates`). A Pauli error is carried through them to
the end of the circuit. Where it anticommutes with P,

    exp(-i a/2 P) E = E exp(+i a/2 P)

so the rotation's angle changes its sign. A Clifford rotation (a an odd multiple of pi/2) stays as it is, and E becomes
E P. At the end, E changes the signs of the measured words that it anticommutes with, and flips bits of the measured
bit strings. The circuit is described once more, with a factor +1 or -1 for each angle: as weights, or as features where
a batch is small, so that a call of the engine runs many patterns.
"""

from collections.abc import Iterator
from functools import lru_cache
from itertools import accumulate
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from qnerf.quantum.circuit import (
    Amplitudes,
    Circuit,
    Expression,
    Gate,
    Hamiltonian,
    Operation,
    Probabilities,
    Weights,
)
from qnerf.quantum.expression_table import offsets
from qnerf.quantum.expressions import feature, weight
from qnerf.quantum.pauli_form import as_gates, only_gates, quarters
from qnerf.quantum.simulator import simulator_of

SMALL = 256  # samples: smaller batches run several patterns at once
AT_ONCE = 1024  # samples of all patterns that run at once


class Turn(NamedTuple):
    """A rotation of a gate, about the X part and the Z part of a word on its wires."""

    wires: list[int]
    x: np.ndarray
    z: np.ndarray
    sign: int | None
    """Which sign its angle takes; None for a Clifford rotation."""


class NoisyGate(NamedTuple):
    """Rotations, then one place for an error on each wire."""

    turns: tuple[Turn, ...]
    wires: list[int]
    spots: slice


def of_patterns(
    circuit: Circuit, x: Tensor, weights: Tensor, x_errors: np.ndarray, z_errors: np.ndarray
) -> Iterator[Tensor]:
    """Outputs (B, outputs) of the circuit with each pattern of errors: boolean (patterns, spots), X part and Z part.

    The spots are the wires of each gate, in order. The weights are flat. Nothing measured may be a Hamiltonian.
    """
    batch = max(len(x), 1)
    all_signs, x_end, z_end = carry(circuit, x_errors, z_errors)
    at_once = max(1, AT_ONCE // batch) if batch < SMALL else 1
    for first in range(0, len(all_signs), at_once):
        part = slice(first, first + at_once)
        signs = torch.from_numpy(all_signs[part]).to(weights)
        if len(signs) == 1:
            outputs = simulator_of(signed(circuit, False))(x, torch.cat([weights, signs[0]]))[None]
        else:
            inputs = torch.cat([x.repeat(len(signs), 1), signs.to(x).repeat_interleave(len(x), 0)], 1)
            outputs = simulator_of(signed(circuit, True))(inputs, weights).unflatten(0, (len(signs), len(x)))
        yield from _measured(circuit, outputs, x_end[part], z_end[part])


def carry(circuit: Circuit, x_errors: np.ndarray, z_errors: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors (patterns, spots), an X part and a Z part, at the end of the circuit.

    Returns the signs (patterns, rotations) of the angles, and the X part and the Z part (patterns, n) of what is left.
    """
    steps = noisy_gates(circuit)
    x, z = (np.zeros((len(x_errors), circuit.wires), bool) for _ in range(2))
    flips = np.zeros((len(x_errors), _signs(steps)), bool)
    for gate in steps:
        for turn in gate.turns:
            odd = ((x[:, turn.wires] & turn.z) ^ (z[:, turn.wires] & turn.x)).sum(1) % 2 == 1
            if turn.sign is not None:
                flips[:, turn.sign] = odd
            else:
                x[:, turn.wires] ^= odd[:, None] & turn.x
                z[:, turn.wires] ^= odd[:, None] & turn.z
        x[:, gate.wires] ^= x_errors[:, gate.spots]
        z[:, gate.wires] ^= z_errors[:, gate.spots]
    return 1.0 - 2.0 * flips, x, z


@lru_cache(maxsize=64)
def noisy_gates(circuit: Circuit) -> tuple[NoisyGate, ...]:
    """All gates in order. Rotations by multiples of pi are left out: they only change signs of errors."""
    steps: list[NoisyGate] = []
    sign = 0
    gates = only_gates(circuit)
    starts = accumulate((len(gate.wires) for gate in gates), initial=0)
    for gate, start in zip(gates, starts, strict=False):
        turns = []
        for part in gate.rotations:
            turned = quarters(gate.angle_of(part))
            if turned in (0, 2):
                continue
            letters = np.array(list(part.letters))
            own = None if turned is not None else sign
            turns.append(Turn(list(gate.wires), np.isin(letters, ["X", "Y"]), np.isin(letters, ["Z", "Y"]), own))
            sign += own is not None
        steps.append(NoisyGate(tuple(turns), list(gate.wires), slice(start, start + len(gate.wires))))
    return tuple(steps)


def _signs(steps: tuple[NoisyGate, ...]) -> int:
    return sum(turn.sign is not None for gate in steps for turn in gate.turns)


@lru_cache(maxsize=64)
def signed(circuit: Circuit, as_features: bool) -> Circuit:
    """The circuit with a factor for the angle of each rotation that is not a Clifford operation.

    The factors are its last features or its last weights; the weights of the circuit before them are flat.
    """
    first, features = offsets(circuit.parameters), circuit.features or 0
    weights = circuit.size

    def own(expression: Expression | float, factor: Expression | float = 1.0) -> Expression:
        return Expression.of(expression).with_flat_weights("weights", first) * factor

    operations: list[Operation] = []
    sign = 0
    for operation in circuit.operations:
        if isinstance(operation, Amplitudes):
            parts = (tuple(map(own, part)) for part in (operation.real, operation.imaginary))
            operations.append(Amplitudes(operation.wires, *parts))
        for gate in as_gates(operation, circuit):
            for part in gate.rotations:
                angle, factor = gate.angle_of(part), Expression.of(1.0)
                if quarters(angle) is None:
                    factor = feature(features + sign) if as_features else weight("weights", weights + sign)
                    sign += 1
                operations.append(Gate("PauliRot", gate.wires, (own(angle, factor),), part.letters))
    extra = 0 if as_features else sign
    tensors = (Weights("weights", (weights + extra,)),) if weights + extra else ()
    return Circuit(
        circuit.name, circuit.wires, operations=tuple(operations), observables=circuit.observables,
        features=features + (sign if as_features else 0), weights=tensors,
    )  # fmt: skip


def _measured(circuit: Circuit, outputs: Tensor, x: np.ndarray, z: np.ndarray) -> Tensor:
    """Outputs (patterns, B, outputs) after errors x, z (patterns, n) at the end, from the outputs before them."""
    places, signs = [], []
    first = 0
    for observable in circuit.observables:
        if isinstance(observable, Probabilities):
            bits = 1 << np.arange(len(observable.wires))[::-1]
            flipped = x[:, observable.wires] @ bits
            places.append(first + (np.arange(2 ** len(bits)) ^ flipped[:, None]))
            signs.append(np.ones_like(places[-1], dtype=float))
        else:
            assert not isinstance(observable, Hamiltonian)
            odd = np.zeros(len(x), int)
            for wire, letter in observable:
                odd += (x[:, wire] & (letter != "X")) ^ (z[:, wire] & (letter != "Z"))
            places.append(np.full((len(x), 1), first))
            signs.append(1.0 - 2.0 * (odd[:, None] % 2))
        first += places[-1].shape[1]
    index = torch.from_numpy(np.concatenate(places, 1)).to(outputs.device)
    factors = torch.from_numpy(np.concatenate(signs, 1)).to(outputs)
    return outputs.gather(2, index[:, None].expand(outputs.shape)) * factors[:, None]
