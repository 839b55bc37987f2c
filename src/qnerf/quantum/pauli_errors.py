"""Noise by sampled Pauli errors: as fast as the exact engines, with a standard error.

A channel that mixes Pauli errors is a lottery: after each gate an X, Y or Z happens on the wire, or nothing. A
draw for all gates is a pattern, and the noisy expectation value is the mean over patterns. The share of runs without
any error, P0, is counted exactly: only patterns with an error are drawn, and the result is P0 exact + (1 - P0) mean.
It has the derivatives of what was drawn.

Each pattern is the same circuit with Pauli gates in it. Its program carries them to the end, where they turn signs.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from qnerf.quantum.circuit import Circuit, Operation
from qnerf.quantum.gates import Gate
from qnerf.quantum.noise import Noise
from qnerf.quantum.simulator import Simulator

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
        x: (B, features).
        weights: flat.
        noise: mixed or twirled to Pauli errors; see `Noise.pauli_probabilities`.
        patterns: drawn; all samples share them.
        random: their source.
        final: an affine function of the outputs.
    """
    clean, *errors = draw(spots(circuit), noise, patterns, random)
    without = exact(x, weights)
    mean = torch.zeros_like(without)
    center = squares = torch.zeros_like(final(without).detach())
    count = 0
    for count, pattern in enumerate(zip(*errors, strict=True), start=1):
        values = Simulator(with_errors(circuit, *pattern))(x, weights)
        mean = mean + (values - mean) / count
        out = final(values).detach()
        change = out - center
        center = center + change / count
        squares = squares + change * (out - center)
    if not count:
        return without, squares
    error = (1 - clean) * (squares / (count - 1) / count).sqrt() if count > 1 else squares * torch.nan
    return clean * without + (1 - clean) * mean, error


def spots(circuit: Circuit) -> list[int]:
    """Where errors can happen: the wires of each gate, in order. Each is given by the number of wires of its gate."""
    return [len(gate.wires) for gate in circuit.gates for _ in gate.wires]


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


def with_errors(circuit: Circuit, x_errors: np.ndarray, z_errors: np.ndarray) -> Circuit:
    """The circuit with one pattern of errors: boolean (spots,), X part and Z part."""
    letters = iter(("", "X", "Z", "Y")[x + 2 * z] for x, z in zip(x_errors.tolist(), z_errors.tolist(), strict=True))
    operations: list[Operation] = []
    for operation in circuit.operations:
        operations.append(operation)
        if isinstance(operation, Gate):
            operations += [Gate(letter, (wire,)) for wire in operation.wires if (letter := next(letters))]
    return replace(circuit, operations=tuple(operations))
