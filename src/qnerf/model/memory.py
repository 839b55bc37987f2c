"""Whether the parameters of a training fit into memory, before any of it is asked for."""

import contextlib
from collections.abc import Callable

import torch
from torch import nn

from qnerf.config import memory

COPIES = 4  # of each parameter: value, gradient, and what the optimiser keeps


def require_parameters(build: Callable[[], nn.Module]) -> None:
    """ValueError if the parameters of what `build` returns need more memory than there is.

    It is called with tensors that have shapes but no memory. A component that needs values is not counted.
    """
    with contextlib.suppress(RuntimeError, NotImplementedError, TypeError):
        with torch.device("meta"):
            parameters = list(build().parameters())
        count, size = sum(one.numel() for one in parameters), sum(one.nbytes for one in parameters)
        hint = "reduce hash.log2_table_size or the width of a head"
        memory.require(f"training {count:,} parameters", COPIES * size, hint=hint)
