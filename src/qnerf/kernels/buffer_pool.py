"""Large arrays that are handed out again once nothing holds them."""

import weakref
from threading import Lock

import numpy as np
import torch
from torch import Tensor

LARGE = 2**20
"""Bytes from which an array is kept: freed, it goes back to the system, and the next one's pages have to be cleared."""

_lock = Lock()
_kept: dict[tuple[int, str], tuple[np.ndarray, "weakref.ref[np.ndarray]"]] = {}


def spare(shape: tuple[int, ...], dtype: np.dtype) -> Tensor:
    """A tensor of `shape` with anything in it; in a training, the memory of the last step's.

    numpy asks for huge pages and PyTorch does not: a fresh 64 MB in small pages costs more than a hash grid's gradient.
    One array a size is kept for the life of the process.
    """
    size = int(np.prod(shape))
    if size * dtype.itemsize < LARGE:
        return torch.from_numpy(np.empty(shape, dtype))
    key = (size, dtype.str)
    with _lock:
        kept = _kept.get(key)
        free = kept is not None and kept[1]() is None
        array = kept[0] if kept is not None and free else np.empty(size, dtype)
        lent = array.view()  # what the tensors over the array keep alive
        _kept[key] = (array, weakref.ref(lent))
    return torch.from_numpy(lent).view(shape)
