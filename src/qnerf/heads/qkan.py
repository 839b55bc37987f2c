"""QKAN: a Kolmogorov-Arnold network whose edges are circuits of one qubit (arXiv:2509.14026, package `qkan`)."""

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from qnerf.config.bounds import Count, Depth, PositiveFactor
from qnerf.heads.base import HEADS, Head


class QKANLayer(nn.Module):
    """(N, in_dim) -> (N, out_dim): y_o = sum over i of <Z>_oi(x_i) + u_oi silu(x_i).

    The qubit of an edge starts in H|0>. `repeats` times it is turned by RZ(theta_0), RY(theta_1) and RZ(w x + b), at
    last by RZ and RY. A state of one qubit is its Bloch vector, three numbers that these turns rotate.
    """

    def __init__(self, in_dim: int, out_dim: int, repeats: int, input_scale: float, trained: bool) -> None:
        super().__init__()
        self.theta = nn.Parameter(torch.empty(out_dim, in_dim, repeats + 1, 2))
        nn.init.xavier_normal_(self.theta)
        self.base = nn.Parameter(torch.full((out_dim, in_dim), 0.5))
        scales = torch.full((out_dim, in_dim, repeats), input_scale)
        self.scales = nn.Parameter(scales) if trained else input_scale
        self.shifts = nn.Parameter(torch.zeros_like(scales)) if trained else None

    def forward(self, x: Tensor) -> Tensor:
        (out_dim, in_dim, turns, _), edges = self.theta.shape, x[:, None, :, None]
        encoded = (edges * self.scales).expand(-1, out_dim, in_dim, turns - 1)
        if self.shifts is not None:
            encoded = encoded + self.shifts
        first, second = self.theta.unbind(-1)  # (out_dim, in_dim, turns)
        state = torch.ones_like(first[..., 0]), torch.zeros_like(first[..., 0]), torch.zeros_like(first[..., 0])
        for turn in range(turns):
            state = rotated_y(rotated_z(state, first[..., turn]), second[..., turn])
            if turn < turns - 1:
                state = rotated_z(state, encoded[..., turn])
        return (state[2] + self.base * nn.functional.silu(x)[:, None, :]).sum(-1)


Bloch = tuple[Tensor, Tensor, Tensor]


def rotated_z(state: Bloch, angle: Tensor) -> Bloch:
    """RZ(angle) of Bloch vectors (x, y, z)."""
    x, y, z = state
    return x * angle.cos() - y * angle.sin(), y * angle.cos() + x * angle.sin(), z


def rotated_y(state: Bloch, angle: Tensor) -> Bloch:
    """RY(angle) of Bloch vectors (x, y, z)."""
    x, y, z = state
    return x * angle.cos() + z * angle.sin(), y, z * angle.cos() - x * angle.sin()


@HEADS.register("qkan")
class QKANHead(Head):
    """`layers` of `QKANLayer`, with nothing between them.

    Args:
        in_dim, out_dim: features in and values out.
        layers: layers.
        width: values between them.
        repeats: r, encodings of an edge's input.
        input_scale: w, radians per unit of the input; 1 as published.
        trained_inputs: whether w and b of each encoding are trained (`preact` in the package).

    An edge has 2 (r + 1) + 1 parameters, and 2 r more with `trained_inputs`.

    >>> QKANHead(3, 4, layers=2, width=5)(torch.zeros(5, 3)).shape
    torch.Size([5, 4])
    """

    quantum = True

    def __init__(
        self,
        in_dim: int,
        out_dim: int,
        *,
        layers: Depth = 2,
        width: Count = 5,
        repeats: Depth = 3,
        input_scale: PositiveFactor = 1.0,
        trained_inputs: bool = False,
    ) -> None:
        super().__init__()
        dims = [in_dim, *[width] * (layers - 1), out_dim]
        made = (QKANLayer(*sizes, repeats, input_scale, trained_inputs) for sizes in pairwise(dims))
        self.layers = nn.Sequential(*made)

    @classmethod
    def label(cls, options: Mapping[str, Any]) -> str:
        """`qkan2x5r3`: layers x width, repeats."""
        return f"qkan{options['layers']}x{options['width']}r{options['repeats']}"

    @classmethod
    def without_effect(cls, options: Mapping[str, Any]) -> tuple[str, ...]:
        return ("width",) if options["layers"] == 1 else ()

    def forward(self, features: Tensor) -> Tensor:
        """(N, in_dim) -> (N, out_dim)."""
        out: Tensor = self.layers(features)
        return out
