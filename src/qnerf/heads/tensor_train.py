"""A tensor train: what a circuit of little entanglement is without its device (arXiv:1605.05775)."""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from qnerf.config.bounds import Count, Factor
from qnerf.heads.base import HEADS, Head


@HEADS.register("tensor_train")
class TensorTrainHead(Head):
    """A product of matrices, one for each angle: the values of a matrix product state, each a multilinear function of
    (cos, sin) of every angle.

    h = W x + b;  v_0 = first row;  v_i = v_(i-1) (cos(h_i) A_i + sin(h_i) B_i);  out = R v_n + c

    Args:
        in_dim, out_dim: features in and values out.
        sites: n, the angles; a circuit of n wires with one encoding takes as many.
        rank: rows and columns of each A_i and B_i. A rank of 2^(n/2) represents every multilinear function.
        input_scale: factor on the angles, radians.

    A_i starts as the identity and B_i as normal numbers with variance 1 / rank; c starts so that angles of 0 give 0.

    >>> TensorTrainHead(3, 4, sites=5, rank=2)(torch.zeros(5, 3)).abs().max() < 1e-6
    tensor(True)
    """

    def __init__(
        self, in_dim: int, out_dim: int, *, sites: Count = 8, rank: Count = 4, input_scale: Factor = 1.0
    ) -> None:
        super().__init__()
        self.linear = nn.Linear(in_dim, sites)
        self.input_scale = input_scale
        self.first = nn.Parameter(torch.randn(rank) / math.sqrt(rank))
        self.cosines = nn.Parameter(torch.eye(rank).repeat(sites, 1, 1))
        self.sines = nn.Parameter(torch.randn(sites, rank, rank) / math.sqrt(rank))
        self.readout = nn.Linear(rank, out_dim)
        if not self.readout.weight.is_meta:
            with torch.no_grad():
                self.linear.bias.zero_()
                self.readout.bias.copy_(-self.readout.weight @ self.first)

    @classmethod
    def label(cls, options: Mapping[str, Any]) -> str:
        """`tt8r4`: sites, rank."""
        return f"tt{options['sites']}r{options['rank']}"

    def forward(self, features: Tensor) -> Tensor:
        """(N, in_dim) -> (N, out_dim)."""
        angles = self.input_scale * self.linear(features)
        state = self.first.expand(len(features), -1)
        for angle, a, b in zip(angles.unbind(1), self.cosines, self.sines, strict=True):
            state = angle[:, None].cos() * (state @ a) + angle[:, None].sin() * (state @ b)
        out: Tensor = self.readout(state)
        return out
