"""A head at some of the points only: the others get 0.

On the CPU the chosen rows are gathered, and the head computes no more than these. On another device that would wait for
the number of rows, in each step. There the head computes all rows, so that shapes are fixed, and its normalisations
count the chosen ones alone.
"""

from collections.abc import Callable

from torch import Tensor, nn

from qnerf.heads.qiren import Normalisation


def gathers(mask: Tensor) -> bool:
    """Whether rows are gathered on this mask's device."""
    return mask.is_cpu


def at_rows(head: nn.Module, rows: Callable[[Tensor | None], Tensor], mask: Tensor) -> Tensor:
    """The head's values where `mask` (..., K) is true, 0 elsewhere: (..., K, out).

    Args:
        head: its normalisations count the chosen rows.
        rows: the head's values (N, out) of the rows with these numbers (N,) among all; None: of all rows.
        mask: bool, row-major as the rows are.

    >>> import torch
    >>> doubled = lambda index: 2 * torch.arange(4.0)[:, None][slice(None) if index is None else index]
    >>> at_rows(nn.Identity(), doubled, torch.tensor([[False, True], [True, False]]))[..., 0].tolist()
    [[0.0, 2.0], [4.0, 0.0]]
    """
    chosen = mask.flatten()
    if gathers(mask):
        index = chosen.nonzero()[:, 0]
        values = rows(index)
        found = values.new_zeros(len(chosen), *values.shape[1:]).index_copy(0, index, values)
    else:
        normalisations = [module for module in head.modules() if isinstance(module, Normalisation)]
        for own in normalisations:
            own.counted = chosen
        try:
            found = rows(None).masked_fill(~chosen[:, None], 0)
        finally:
            for own in normalisations:
                own.counted = None
    return found.view(*mask.shape, *found.shape[1:])
