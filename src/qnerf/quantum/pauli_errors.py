"""Noise by sampled Pauli errors: as fast as the exact engines, with a standard error.

A channel that mixes Pauli errors is a lottery: after each gate an X, Y or Z happens on the wire, or nothing. A
draw for all gates is a pattern, and the noisy expectation value is the mean over patterns. Each pattern is the same
circuit with other angles: the errors become part of the trainable rotations (`folded_errors`). The share of runs
without any error, P0, is counted exactly: only patterns with an error are drawn, and the result is
P0 exact + (1 - P0) mean. It has the derivatives of what was drawn.
"""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import torch
from torch import Tensor

from qnerf.quantum import folded_errors
from qnerf.quantum.circuit import Circuit
from qnerf.quantum.folded_errors import Exact
from qnerf.quantum.noise import Noise
from qnerf.quantum.pauli_form import only_gates

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
    folded_errors.check_folds(circuit)
    clean, *errors = draw(spots(circuit), noise, patterns, random)
    of_patterns = folded_errors.of_patterns(exact, circuit, x, weights, *errors)
    return mean_of(clean, exact(x, weights), of_patterns, final)


def spots(circuit: Circuit) -> list[int]:
    """Where errors can happen: the wires of each gate, in order. Each is given by the number of wires of its gate."""
    return [len(gate.wires) for gate in only_gates(circuit) for _ in gate.wires]


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

    The patterns are two boolean arrays (patterns, spots), an X part and a Z part; both make a Y. `sizes` are those of
    `spots`. There are no patterns where no error can happen.
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
