"""Which samples get a colour: the colour head, a circuit above all, is the costliest part of a field, and most samples
of a ray lie in front of its surface or behind it. A sample without geometry never gets one: it weighs nothing.
"""

import torch
from torch import Tensor, nn

from qnerf.checks import at_least
from qnerf.registry import Registry

GATES: "Registry[Gate]" = Registry("gate")


class Gate(nn.Module):
    """Which samples get a colour (R, K), or None for all; every ray keeps its largest share.

    Of the samples' shares (R, K) in their rays' colours, at least 0, and which of them were evaluated (R, K), None for
    all; one at least on each ray. It decides alike in training and evaluation, so that a head's normalisation sees the
    same kind of samples in both.
    """

    def forward(self, shares: Tensor, evaluated: Tensor | None = None) -> Tensor | None:
        raise NotImplementedError


@GATES.register("none")
class NoGate(Gate):
    """Every sample that has a geometry gets a colour."""

    def forward(self, shares: Tensor, evaluated: Tensor | None = None) -> Tensor | None:
        return evaluated


@GATES.register("threshold")
class ThresholdGate(Gate):
    """Samples whose share is at least `least`: what is left out of a ray sums to less than K `least`.

    Args:
        least: share of a ray's colour, 0 to 1.
    """

    def __init__(self, *, least: float = 1e-3) -> None:
        super().__init__()
        if not 0 <= least < 1:
            raise ValueError(f"gate=threshold: least must be at least 0 and below 1, got {least}")
        self.least = least

    @torch.no_grad()
    def forward(self, shares: Tensor, evaluated: Tensor | None = None) -> Tensor:
        largest = shares.amax(-1, keepdim=True)
        kept = shares >= largest.clamp(max=self.least)
        return kept if evaluated is None else kept & evaluated


@GATES.register("top")
class TopGate(Gate):
    """The `samples` largest shares of each ray.

    Args:
        samples: at least 1.
    """

    def __init__(self, *, samples: int = 8) -> None:
        super().__init__()
        at_least("samples", samples, 1)
        self.samples = samples

    @torch.no_grad()
    def forward(self, shares: Tensor, evaluated: Tensor | None = None) -> Tensor:
        count = min(self.samples, shares.shape[-1])
        if evaluated is not None:
            shares = shares.masked_fill(~evaluated, -1)
        kept = torch.zeros_like(shares, dtype=torch.bool).scatter_(-1, shares.topk(count, dim=-1).indices, True)
        return kept if evaluated is None else kept & evaluated
