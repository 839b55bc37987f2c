"""What is read one by one, and what errors of the readout make of it, exactly.

Each wire is read wrongly by itself, with probability p. So a word of k letters is read as (1 - 2 p)^k times the word.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from qnerf.quantum.circuit import Circuit, PauliWord, Probabilities, as_sum, values_of
from qnerf.quantum.noise import Noise


@dataclass(frozen=True)
class Measured:
    """What is measured one by one: the words and the probabilities that a circuit's outputs are made of.

    Attributes:
        observables: Pauli words and `Probabilities`, all different.
        places: of each observable, its first value.
        values: how many values they have together.
        combination: (outputs, values); outputs = combination @ values + constants. None where the outputs are the
            values.
        constants: (outputs,).
    """

    observables: tuple[PauliWord | Probabilities, ...]
    places: tuple[int, ...]
    values: int
    combination: np.ndarray | None
    constants: np.ndarray

    def outputs(self, values: Tensor) -> Tensor:
        """Outputs (B, outputs) for values (B, values)."""
        if self.combination is None:
            return values
        return values @ torch.from_numpy(self.combination).to(values).T + torch.from_numpy(self.constants).to(values)


@lru_cache(maxsize=256)
def measured(circuit: Circuit) -> Measured:
    """The values that the outputs of a circuit are made of."""
    places: dict[PauliWord | Probabilities, int] = {}
    entries: list[tuple[int, int, float]] = []
    constants = np.zeros(circuit.outputs)
    values = output = 0
    for observable in circuit.observables:
        size = values_of(observable)
        terms: list[tuple[PauliWord | Probabilities, float]]
        if isinstance(observable, Probabilities):
            terms = [(observable, 1.0)]
        else:
            sums = as_sum(observable)
            terms = [(tuple(sorted(word)), c) for word, c in zip(sums.words, sums.coefficients, strict=True)]
        for part, coefficient in terms:
            if not part:
                constants[output] += coefficient
                continue
            first = places.setdefault(part, values)
            values = max(values, first + size)
            entries += [(output + k, first + k, coefficient) for k in range(size)]
        output += size
    combination = np.zeros((output, values))
    for row, column, coefficient in entries:
        combination[row, column] += coefficient
    are_values = output == values and not constants.any() and np.array_equal(combination, np.eye(values))
    return Measured(tuple(places), tuple(places.values()), values, None if are_values else combination, constants)


def as_read(found: Measured, values: Tensor, noise: Noise) -> Tensor:
    """The values (B, values) as they are read, from the exact ones."""
    if not noise.readout:
        return values
    parts = values.split(list(map(values_of, found.observables)), 1)
    read = [
        part * (1 - 2 * noise.readout) ** len(observable)
        if isinstance(observable, tuple)
        else _confused(part, noise.readout)
        for observable, part in zip(found.observables, parts, strict=True)
    ]
    return torch.cat(read, 1)


def _confused(probabilities: Tensor, p: float) -> Tensor:
    """Probabilities (B, 2^k) of the bit strings that are read."""
    batch, size = probabilities.shape
    for wire in range(size.bit_length() - 1):
        view = probabilities.reshape(batch * 2**wire, 2, size >> (wire + 1))
        probabilities = (1 - p) * view + p * view.flip(1)
    return probabilities.reshape(batch, size)
