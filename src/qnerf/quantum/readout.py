"""What is read one by one, and what errors of the readout make of it, exactly.

Each wire is read wrongly by itself: 1 for 0 with probability u, 0 for 1 with probability d. So a letter P on a wire is
read as a P + b with a = 1 - u - d and b = d - u, and a word of k letters as the product of k such factors. With u = d
that is a^k times the word; otherwise the words of fewer letters come in.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np
import torch
from torch import Tensor

from qnerf.quantum.circuit import Circuit, Observable, PauliWord, Probabilities, as_sum, values_of
from qnerf.quantum.noise import Noise

MAX_LETTERS = 10  # of a word that is read with two different probabilities: it becomes 2^letters words


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


class Readout:
    """How Pauli words and `Probabilities` are read.

    Attributes:
        observables: what must be known to compute them, words first.

    Raises:
        ValueError: two different probabilities, and a word of more than 10 letters.
    """

    def __init__(self, observables: tuple[Observable, ...], noise: Noise) -> None:
        a, b = noise.readout_factors
        up = (1 - a - b) / 2
        self.confusion = torch.tensor([[1 - up, 1 - a - up], [up, a + up]], dtype=torch.float64)  # [read, is]
        self.sizes = list(map(values_of, observables))
        self.tables = [isinstance(o, Probabilities) for o in observables]
        index: dict[PauliWord, int] = {}
        entries: list[tuple[int, int, float]] = []
        self.constants = torch.zeros(len(observables) - sum(self.tables), dtype=torch.float64)
        words = [o for o in observables if isinstance(o, tuple)]
        for row, word in enumerate(words):
            if b and len(word) > MAX_LETTERS:
                raise ValueError(
                    f"noise: two probabilities of readout={noise.readout} expect words of at most {MAX_LETTERS} "
                    f"letters, got one of {len(word)}; give one probability"
                )
            for size in range(len(word) + 1) if b else (len(word),):
                factor = a**size * b ** (len(word) - size)
                if not size:
                    self.constants[row] += factor
                    continue
                for part in combinations(word, size):
                    entries.append((row, index.setdefault(part, len(index)), factor))
        matrix = np.zeros((len(words), len(index)))
        for row, column, factor in entries:
            matrix[row, column] += factor
        self.matrix = torch.from_numpy(matrix)
        self.is_diagonal = len(words) == len(index) and np.array_equal(matrix, np.diag(matrix.diagonal()))
        self.observables: tuple[Observable, ...] = (*index, *(o for o in observables if isinstance(o, Probabilities)))
        self.observables = self.observables or ((),)

    def __call__(self, values: Tensor) -> Tensor:
        """The values (B, values) that are read, from the exact values of `observables`."""
        matrix, count = self.matrix.to(values), self.matrix.shape[1]
        words = values[:, :count] * matrix.diagonal() if self.is_diagonal else values[:, :count] @ matrix.T
        words = words + self.constants.to(values)
        read, first, row = [], count, 0
        for size, is_table in zip(self.sizes, self.tables, strict=True):
            if is_table:
                read.append(self._confused(values[:, first : first + size]))
                first += size
            else:
                read.append(words[:, row : row + 1])
                row += 1
        return torch.cat(read, 1)

    def _confused(self, probabilities: Tensor) -> Tensor:
        """Probabilities (B, 2^k) of the bit strings that are read."""
        confusion, (batch, size) = self.confusion.to(probabilities), probabilities.shape
        for wire in range(size.bit_length() - 1):
            view = probabilities.reshape(batch * 2**wire, 2, size >> (wire + 1))
            probabilities = torch.einsum("ri,bia->bra", confusion, view)
        return probabilities.reshape(batch, size)
