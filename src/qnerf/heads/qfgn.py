"""QFGN: Fourier-Gaussian preprocessing before the first circuit of a quantum head (arXiv:2504.19053)."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from qnerf.config.bounds import Count, NonNegativeFactor, PositiveFactor
from qnerf.heads.base import HEADS
from qnerf.heads.qiren import QirenHead, Statistics
from qnerf.quantum import QuantumLayer


class FourierGaussianLayer(nn.Module):
    """Fourier basis, linear map, Gaussian weighting, circuit: (N, in_dim) -> (N, wires).

    h1 = Lambda B(x) + b with B(x) = (cos Wx, sin Wx), W fixed;  h2 = exp(-gamma h1^2) h1;  the angles are h2, radians.
    """

    frequencies: Tensor

    def __init__(
        self, in_dim: int, wires: int, circuit: QuantumLayer, features: int, scale: float, gamma: float
    ) -> None:
        super().__init__()
        self.register_buffer("frequencies", torch.randn(features // 2, in_dim) * scale)
        self.linear = nn.Linear(features, wires)
        self.circuit = circuit
        self.gamma = gamma

    def forward(self, features: Tensor) -> Tensor:
        phases = nn.functional.linear(features, self.frequencies)
        h = self.linear(torch.cat([phases.cos(), phases.sin()], dim=-1))
        return self.circuit(h * torch.exp(-self.gamma * h.square()))


@HEADS.register("qfgn")
class QFGNHead(QirenHead):
    """A QIREN head whose first hybrid layer is Fourier-Gaussian.

    Args (besides the options of `QirenHead`):
        features: Fourier features, cosines and sines together; even.
        scale: standard deviation of the fixed frequencies, radians per input unit.
        gamma: shape of the Gaussian weighting.

    The first layer does not normalise: `input_scale` and `statistics` act on the later layers only.
    """

    @classmethod
    def label(cls, options: Mapping[str, Any]) -> str:
        """`qfgn-1L2S`"""
        return f"qfgn-{super().label(options)}"

    def __init__(
        self,
        in_dim: int,
        out_dim: int,
        *,
        features: Count = 16,
        scale: PositiveFactor = 1.0,
        gamma: NonNegativeFactor = 0.5,
        **options: Any,
    ) -> None:
        if features % 2:
            raise ValueError(f"qfgn features must be even (a cosine and a sine each), got {features}")
        self._fourier = (features, scale, gamma)
        super().__init__(in_dim, out_dim, **options)

    def hybrid_layer(
        self, index: int, in_dim: int, wires: int, circuit: QuantumLayer, input_scale: float, statistics: Statistics
    ) -> nn.Module:
        if index == 0:
            return FourierGaussianLayer(in_dim, wires, circuit, *self._fourier)
        return super().hybrid_layer(index, in_dim, wires, circuit, input_scale, statistics)
