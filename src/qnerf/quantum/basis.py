"""What gates do to the 2^n basis states, as tables. A wire is a bit of a basis state's number (`bit`)."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

Pairs = Sequence[tuple[int, int]]


def bit(wire: int, wires: int) -> int:
    """The bit of a wire: wire 0 is the most significant, as in PennyLane."""
    return 1 << (wires - 1 - wire)


def z_signs(masks: Sequence[int], wires: int) -> np.ndarray:
    """(masks, 2^n): the eigenvalue +1 or -1 of the product of Z on the bits of each mask, in each basis state."""
    basis = np.arange(2**wires)
    odd = np.bitwise_count(basis & np.array(masks, dtype=np.int64).reshape(-1, 1)).astype(np.int64) & 1
    return 1.0 - 2.0 * odd


def cz_signs(pairs: Pairs, wires: int) -> np.ndarray:
    """(2^n,): the diagonal of a product of CZ on pairs of bits, +1 or -1."""
    basis = np.arange(2**wires)
    odd = np.zeros(2**wires, dtype=np.int64)
    for a, b in pairs:
        odd += (basis & a != 0) & (basis & b != 0)
    return 1.0 - 2.0 * (odd % 2)


def cnot_permutation(pairs: Pairs, wires: int) -> np.ndarray:
    """(2^n,): the state after the CNOTs on pairs of bits (control, target), in this order, is `before[permutation]`."""
    index = np.arange(2**wires)
    for control, target in reversed(pairs):
        index = np.where(index & control, index ^ target, index)
    return index


_copies: dict[tuple[int, torch.device, torch.dtype | None], tuple[np.ndarray, Tensor]] = {}


def placed(array: np.ndarray, device: torch.device, dtype: torch.dtype | None = None) -> Tensor:
    """An array of a circuit on a device; `dtype` None keeps its own.

    Another device than the CPU keeps its copy: to send one in each step would be to wait for the device. A tensor that
    is kept on the CPU would keep the mode of PyTorch in which it was made.
    """
    if device.type == "cpu":
        return torch.from_numpy(array).to(dtype=dtype)
    own = id(array), device, dtype
    if own not in _copies:
        with torch.inference_mode(False):  # it is kept for training, too
            _copies[own] = array, torch.from_numpy(array).to(device, dtype)
    return _copies[own][1]
