"""Large buffers that are used again once nothing holds them."""

import weakref
from threading import Lock

import numpy as np
import torch
from torch import Tensor

LARGE = 2**20
"""Bytes from which a buffer is pooled. The system takes back such memory when it is freed, and clears the next one."""

_lock = Lock()
_pool: dict[tuple[int, str], tuple[np.ndarray, "weakref.ref[np.ndarray]"]] = {}


def pooled_empty(shape: tuple[int, ...], dtype: np.dtype) -> Tensor:
    """A tensor of `shape` with arbitrary contents; in training, the memory of the last step's.

    The memory comes from NumPy, which asks for huge pages where PyTorch does not: a fresh 64 MB in small pages costs
    more than computing a hash grid's gradient. One buffer for each size and dtype stays for the life of the process.
    """
    size = int(np.prod(shape))
    if size * dtype.itemsize < LARGE:
        return torch.from_numpy(np.empty(shape, dtype))
    key = (size, dtype.str)
    with _lock:
        pooled = _pool.get(key)
        free = pooled is not None and pooled[1]() is None
        buffer = pooled[0] if pooled is not None and free else np.empty(size, dtype)
        view = buffer.view()  # tensors over the buffer keep this view alive
        _pool[key] = (buffer, weakref.ref(view))
    return torch.from_numpy(view).view(shape)
