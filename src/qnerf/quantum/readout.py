"""What errors of the readout make of what is read, exactly.

Each wire is read wrongly by itself, with probability p. So a word of k letters is read as (1 - 2 p)^k times the word.
"""

import torch
from torch import Tensor

from qnerf.quantum.circuit import values_of
from qnerf.quantum.noise import Noise
from qnerf.quantum.program import Program


def as_read(found: Program, values: Tensor, noise: Noise) -> Tensor:
    """The values (B, values) as they are read, from the exact ones."""
    if not noise.readout:
        return values
    parts = values.split(list(map(values_of, found.read)), 1)
    read = [
        part * (1 - 2 * noise.readout) ** len(observable)
        if isinstance(observable, tuple)
        else _confused(part, noise.readout)
        for observable, part in zip(found.read, parts, strict=True)
    ]
    return torch.cat(read, 1)


def _confused(probabilities: Tensor, p: float) -> Tensor:
    """Probabilities (B, 2^k) of the bit strings that are read."""
    batch, size = probabilities.shape
    for wire in range(size.bit_length() - 1):
        view = probabilities.reshape(batch * 2**wire, 2, size >> (wire + 1))
        probabilities = (1 - p) * view + p * view.flip(1)
    return probabilities.reshape(batch, size)
