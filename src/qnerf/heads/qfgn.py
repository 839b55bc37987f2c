"""QFGN: Fourier-Gaussian preprocessing before the first circuit of a quantum head (arXiv:2504.19053)."""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from qnerf.config.checks import at_least
from qnerf.heads.base import HEADS
from qnerf.heads.qiren import QirenHead
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

    Args (besides those of `QirenHead`):
        features: Fourier features, cosines and sines together; even, at least 2.
        scale: standard deviation of the fixed frequencies, radians per input unit, above 0.
        gamma: shape of the Gaussian weighting, at least 0.

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
        features: int = 16,
        scale: float = 1.0,
        gamma: float = 0.5,
        **options: Any,
    ) -> None:
        at_least("features", features, 2)
        if features % 2:
            raise ValueError(f"qfgn features must be even (a cosine and a sine each), got {features}")
        if not scale > 0 or not gamma >= 0 or math.isinf(gamma):
            raise ValueError(f"qfgn needs scale > 0 and a finite gamma >= 0, got scale={scale}, gamma={gamma}")
        self._fourier = (features, scale, gamma)
        super().__init__(in_dim, out_dim, **options)

    def hybrid_layer(
        self, index: int, in_dim: int, wires: int, circuit: QuantumLayer, input_scale: float, statistics: str
    ) -> nn.Module:
        if index == 0:
            return FourierGaussianLayer(in_dim, wires, circuit, *self._fourier)
        return super().hybrid_layer(index, in_dim, wires, circuit, input_scale, statistics)
