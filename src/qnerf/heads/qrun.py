"""Q-RUN: data re-uploading units without a circuit, as in the public code of arXiv:2512.20654 (QuaRobot/Q-RUN)."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from qnerf.config.bounds import Count, Depth, PositiveFactor
from qnerf.heads.base import HEADS, Head


class ReuploadingUnits(nn.Module):
    """A linear map, and one small network that all its values share: (N, in_dim) -> (N, 2 units).

    h = W x + b. Each h_j becomes sin(net(sin h_j, cos h_j, sin h_j, cos h_j)), two values side by side. `net` is an MLP
    4 -> 9 -> 9 -> 2 with tanh.
    """

    def __init__(self, in_dim: int, units: int) -> None:
        super().__init__()
        self.linear = nn.Linear(in_dim, units)
        self.net = nn.Sequential(nn.Linear(4, 9), nn.Tanh(), nn.Linear(9, 9), nn.Tanh(), nn.Linear(9, 2))

    def forward(self, x: Tensor) -> Tensor:
        h = self.linear(x)
        once = torch.stack([h.sin(), h.cos()], dim=-1)
        return self.net(torch.cat([once, once], dim=-1)).sin().flatten(-2)


@HEADS.register("qrun")
class QRunHead(Head):
    """A linear map, layers - 1 of `ReuploadingUnits`, and a linear map. All weights start as PyTorch's.

    Args:
        in_dim, out_dim: features in and values out.
        layers: of units, and one.
        width: values between the layers, an even number: two for each unit.
        input_scale: factor on the values of the first linear map; 1 as published.

    >>> head = QRunHead(2, 1, layers=2, width=28)
    >>> sum(parameter.numel() for parameter in head.parameters())  # as in the code
    674
    """

    def __init__(
        self, in_dim: int, out_dim: int, *, layers: Depth = 2, width: Count = 28, input_scale: PositiveFactor = 1.0
    ) -> None:
        super().__init__()
        if width % 2:
            raise ValueError(f"qrun.width must be even, two values for each unit, got {width}")
        self.input_scale = input_scale
        self.first = nn.Linear(in_dim, width)
        self.hidden = nn.Sequential(*(ReuploadingUnits(width, width // 2) for _ in range(layers - 1)))
        self.readout = nn.Linear(width, out_dim)

    @classmethod
    def label(cls, options: Mapping[str, Any]) -> str:
        """`qrun2x28`: layers x width."""
        return f"qrun{options['layers']}x{options['width']}"

    def forward(self, features: Tensor) -> Tensor:
        """(N, in_dim) -> (N, out_dim)."""
        out: Tensor = self.readout(self.hidden(self.input_scale * self.first(features)))
        return out
