"""SIREN: an MLP with sines (arXiv:2006.09661), a control for circuits, whose values are trigonometric, too."""

from collections.abc import Collection, Mapping
from itertools import pairwise
from math import sqrt
from typing import Any

import torch
from torch import Tensor, nn

from qnerf.config.bounds import Count, Depth, PositiveFactor
from qnerf.heads.base import HEADS, Head


@HEADS.register("siren")
class SirenHead(Head):
    """`layers` linear layers with sin(omega (W x + b)) between them, nothing after the last.

    Args:
        in_dim, out_dim: features in and values out.
        layers: linear layers.
        width: hidden units.
        omega: factor before each sine, radians.

    The weights start as published: uniform in +-1/in_dim in the first layer, in +-sqrt(6/inputs)/omega in the others.

    >>> SirenHead(3, 4, layers=2, width=8)(torch.zeros(5, 3)).shape
    torch.Size([5, 4])
    """

    def __init__(
        self, in_dim: int, out_dim: int, *, layers: Depth = 2, width: Count = 64, omega: PositiveFactor = 30.0
    ) -> None:
        super().__init__()
        self.omega = omega
        dims = [in_dim, *[width] * (layers - 1), out_dim]
        self.layers = nn.ModuleList([nn.Linear(before, after) for before, after in pairwise(dims)])
        for index, before in enumerate(dims[:-1]):
            bound = 1 / before if index == 0 else sqrt(6 / before) / omega
            nn.init.uniform_(self.layers[index].weight, -bound, bound)  # type: ignore[arg-type]

    @classmethod
    def label(cls, options: Mapping[str, Any]) -> str:
        """`siren2x64`: layers x width."""
        return f"siren{options['layers']}x{options['width']}"

    @classmethod
    def without_effect(cls, options: Mapping[str, Any]) -> Collection[str]:
        return ("width", "omega") if options["layers"] == 1 else ()

    def forward(self, features: Tensor) -> Tensor:
        """(N, in_dim) -> (N, out_dim)."""
        for layer in self.layers[:-1]:
            features = torch.sin(self.omega * layer(features))
        return self.layers[-1](features)
