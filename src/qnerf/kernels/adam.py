"""A step of Adam (arXiv:1412.6980) for all parameters in one compiled CPU loop; its reference is `torch.optim.Adam`."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import types
from torch import Tensor

from qnerf.kernels.hashgrid import U
from qnerf.kernels.jit import flat, jit, run
from qnerf.kernels.simd import intrinsic

GRAIN = 2**20  # numbers that are worth waking a thread for


class Update(NamedTuple):
    """One parameter and its moments."""

    tensors: tuple[Tensor, Tensor, Tensor, Tensor]
    """The parameter, its gradient, and the running means of gradients and of their squares: all contiguous and of one
    shape and dtype."""
    rate: float
    """Learning rate over 1 - beta1^step."""
    scale: float
    """(1 - beta2^step)^(-1/2)."""


def adam(updates: Sequence[Update], beta1: float, beta2: float, eps: float) -> None:
    """Changes parameters and moments in place."""
    places = np.array([tensor.data_ptr() for update in updates for tensor in update.tensors]).reshape(-1, 4)
    ends = np.cumsum([update.tensors[0].numel() for update in updates])
    like = flat(updates[0].tensors[0])
    factors = np.array([update[1:] for update in updates], like.dtype)
    numbers = (like.dtype.type(number) for number in (1 - beta1, beta2, 1 - beta2, eps))
    run(_adam, int(ends[-1]), places, ends, factors, *numbers, like, grain=GRAIN)


@intrinsic
def _pointer(typing_context: Any, address: Any, like: Any) -> Any:
    """The address of numbers of the dtype of an array, as a pointer to them."""
    kind = types.CPointer(like.dtype)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(kind))

    return kind(types.int64, like), generate


@jit
def _adam(start, stop, places, ends, factors, new, old_square, new_square, eps, like):  # type: ignore[no-untyped-def]
    """Changes the numbers start..stop, counted through all parameters."""
    before = 0
    for each in range(ends.size):
        # The part of this parameter that lies between start and stop.
        first, last = max(start - before, 0), min(stop, ends[each]) - before
        size = (ends[each] - before,)
        before = ends[each]
        if first >= last:
            continue
        parameter = numba.carray(_pointer(places[each, 0], like), size)
        gradient = numba.carray(_pointer(places[each, 1], like), size)
        mean = numba.carray(_pointer(places[each, 2], like), size)
        square = numba.carray(_pointer(places[each, 3], like), size)
        rate, scale = factors[each, 0], factors[each, 1]
        # One pass over all four arrays: LLVM turns it into vectors.
        for i in range(U(first), U(last)):
            g = gradient[i]
            mean[i] += new * (g - mean[i])
            square[i] = old_square * square[i] + new_square * g * g
            parameter[i] -= rate * mean[i] / (np.sqrt(square[i]) * scale + eps)
