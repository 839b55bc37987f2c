"""`Lattice`: a signal that is given on a regular lattice, and of which some points may be kept out of training."""

import copy
from collections.abc import Sequence
from typing import Annotated, Self

import torch
from annotated_types import Interval
from torch import Tensor

from qnerf.scenes.base import hold_out
from qnerf.signals.base import Signal

HeldOut = Annotated[float, Interval(ge=0, le=0.9)]
"""Share of a lattice that training never sees."""


class Lattice(Signal):
    """Values on a regular lattice, fitted at its points; a share of them, the same for each seed, is unseen."""

    def lay(self, truth: Tensor, held_out: float) -> None:
        """truth: (H, W, C) or (N, C), the first coordinate along the last axis but one; held_out: share unseen."""
        self.truth = truth
        self.everywhere = grid(truth.shape[:-1])
        count = len(self.everywhere)
        unseen = round(held_out * count)
        order = torch.randperm(count, generator=torch.Generator().manual_seed(0))
        self.unseen, seen = order[:unseen].sort().values, order[unseen:].sort().values
        self.measured = torch.arange(count)  # points: all, or without those of the test
        self._train_on(seen)

    def _train_on(self, seen: Tensor) -> None:
        self.points, self.targets = self.everywhere[seen], self.truth.flatten(0, -2)[seen]
        self.seen = seen

    @property
    def tests_unseen(self) -> bool:
        return len(self.unseen) > 0

    @property
    def is_whole(self) -> bool:
        """Whether all points are measured: none is kept for a test while others validate."""
        return len(self.measured) == len(self.everywhere)

    def validating(self, share: float) -> Self:
        """The signal without the points of the test, which are 0; of the others some validate."""
        found = copy.copy(self)
        seen, unseen = (torch.tensor(points) for points in hold_out(self.seen.tolist(), share))
        found.measured, found.unseen, found.truth = self.seen, unseen, self.truth.clone()
        found.truth.flatten(0, -2)[self.unseen] = 0
        found._train_on(seen)
        return found

    def terms(self, predicted: Tensor, targets: Tensor) -> dict[str, Tensor]:
        return {"mse": torch.nn.functional.mse_loss(predicted, targets)}


def grid(sides: Sequence[int]) -> Tensor:
    """(points, D) float64: the middles of a lattice's cells in the unit cube, row by row.

    sides: cells along each axis, the last coordinate's first, as in (height, width) for x and y.
    """
    axes = torch.meshgrid(*map(centres, sides), indexing="ij")
    return torch.stack(axes[::-1], dim=-1).view(-1, len(sides))


def centres(count: int) -> Tensor:
    """(count,) float64: the middles of `count` equal parts of [0, 1].

    >>> centres(2).tolist()
    [0.25, 0.75]
    """
    return (torch.arange(count, dtype=torch.float64) + 0.5) / count
