"""Data re-uploading without a circuit, for a linear layer: our reading of Q-RUN's abstract (arXiv:2512.20654)."""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from qnerf.config.bounds import Count, Depth, PositiveFactor
from qnerf.heads.base import HEADS, Head
from qnerf.quantum.circuit import Spectral


class ReuploadingLayer(nn.Module):
    """A linear layer and a Fourier series for each unit: (N, in_dim) -> (N, out_dim).

    h = W x + b;  y_j = a_j0 + sum over s of a_js cos(f_js h_j) + b_js sin(f_js h_j)

    A wire that encodes h_j S times has such values (arXiv:2008.08605), with s = 1, ..., S. Here its coefficients are
    free, and its frequencies f are trained from 1, ..., S.
    """

    def __init__(self, in_dim: int, out_dim: int, spectral: int, scale: float) -> None:
        super().__init__()
        self.linear = nn.Linear(in_dim, out_dim)
        self.scale = scale
        self.frequencies = nn.Parameter(torch.arange(1.0, spectral + 1).expand(out_dim, -1).clone())
        self.cosines = nn.Parameter(torch.randn(out_dim, spectral) / math.sqrt(spectral))
        self.sines = nn.Parameter(torch.randn(out_dim, spectral) / math.sqrt(spectral))
        self.constant = nn.Parameter(torch.zeros(out_dim))

    def forward(self, x: Tensor) -> Tensor:
        phases = self.scale * self.linear(x)[..., None] * self.frequencies
        return self.constant + (self.cosines * phases.cos() + self.sines * phases.sin()).sum(-1)


@HEADS.register("qrun")
class QRunHead(Head):
    """An MLP whose hidden layers are `ReuploadingLayer`: layers - 1 of them, then a linear map.

    Args:
        in_dim, out_dim: features in and values out.
        layers: layers, the last linear map included.
        width: units of each hidden layer.
        spectral: S, the frequencies of a unit.
        scale: factor on the linear maps' values, radians.

    A hidden layer has width (inputs + 2 + 3 S) parameters.

    >>> QRunHead(3, 4, layers=2, width=8)(torch.zeros(5, 3)).shape
    torch.Size([5, 4])
    """

    def __init__(
        self,
        in_dim: int,
        out_dim: int,
        *,
        layers: Depth = 2,
        width: Count = 16,
        spectral: Spectral = 2,
        scale: PositiveFactor = 1.0,
    ) -> None:
        super().__init__()
        dims = [in_dim, *[width] * (layers - 1)]
        self.hidden = nn.Sequential(*(ReuploadingLayer(*sizes, spectral, scale) for sizes in pairwise(dims)))
        self.readout = nn.Linear(dims[-1], out_dim)

    @classmethod
    def label(cls, options: Mapping[str, Any]) -> str:
        """`qrun2x16S2`: layers x width, frequencies."""
        return f"qrun{options['layers']}x{options['width']}S{options['spectral']}"

    @classmethod
    def without_effect(cls, options: Mapping[str, Any]) -> tuple[str, ...]:
        return ("width", "spectral", "scale") if options["layers"] == 1 else ()

    def forward(self, features: Tensor) -> Tensor:
        """(N, in_dim) -> (N, out_dim)."""
        out: Tensor = self.readout(self.hidden(features))
        return out
