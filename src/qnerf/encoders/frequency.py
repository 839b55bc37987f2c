"""Sines and cosines of the coordinates: on fixed bands, or along random directions.

Phases are computed in float64 and reduced to half a turn before they are cast to the points' dtype. A float32 feature
is then within 5e-7 of the exact one, while a float32 phase of 2 pi 2^8 x would be off by 1e-4.
"""

import math
from typing import Annotated

import torch
from annotated_types import Interval
from torch import Tensor

from qnerf.config.bounds import Count, NonNegativeFactor, Seed
from qnerf.encoders.registry import ENCODERS, Encoder


def sin_cos_turns(turns: Tensor, dtype: torch.dtype) -> Tensor:
    """sin and cos of `turns` (..., F), float64, in full turns -> (..., 2 F) in `dtype`, sines first."""
    assert turns.dtype == torch.float64
    phase = ((turns - turns.detach().round()) * (2 * math.pi)).to(dtype)
    return torch.cat((phase.sin(), phase.cos()), dim=-1)


@ENCODERS.register("pe")
class PositionalEncoding(Encoder):
    """sin and cos of 2 pi f_b x for every coordinate x and band b (Eq. 4, arXiv:2003.08934, with f_b in cycles).

    Args:
        bands: number of frequencies f_b = 2^e_b, with e_b even from 0 to max_exponent.
        max_exponent: exponent of the highest band; 8 means 256 cycles across the unit cube.
        include_input: append the coordinates themselves.

    Sines come first, then cosines, then the input. Sines and cosines go coordinate by coordinate, low band first.

    >>> PositionalEncoding(3, bands=10)(torch.zeros(5, 3)).shape
    torch.Size([5, 60])
    """

    trainable = False

    def __init__(
        self,
        in_dim: int,
        *,
        bands: Count = 10,
        max_exponent: Annotated[float, Interval(ge=0, le=52)] = 8.0,
        include_input: bool = False,
    ) -> None:
        super().__init__(in_dim)
        self.include_input = include_input
        self.out_dim = 2 * in_dim * bands + in_dim * include_input
        # No buffer: the frequencies stay float64 when the module is cast.
        self.frequencies = 2 ** torch.linspace(0, max_exponent, bands, dtype=torch.float64)

    def forward(self, points: Tensor) -> Tensor:
        self.frequencies = self.frequencies.to(points.device)  # once: a copy waits for the device
        turns = points.to(torch.float64)[..., None] * self.frequencies
        encoded = sin_cos_turns(turns.flatten(-2), points.dtype)
        return torch.cat((encoded, points), dim=-1) if self.include_input else encoded


@ENCODERS.register("rff")
class FourierFeatures(Encoder):
    """sin and cos of 2 pi B x with fixed B ~ N(0, scale^2) (Sec. 6.1, arXiv:2006.10739).

    Args:
        features: rows of B; the encoding has twice as many features.
        scale: standard deviation of B, in cycles across the unit cube.
        seed: of B, which is drawn from a separate generator.
    """

    trainable = False

    directions: Tensor

    def __init__(self, in_dim: int, *, features: Count = 30, scale: NonNegativeFactor = 10.0, seed: Seed = 0) -> None:
        super().__init__(in_dim)
        self.out_dim = 2 * features
        generator = torch.Generator().manual_seed(seed)
        # Drawn in float32, so that float32 and float64 modules have the same B.
        normal = torch.randn(in_dim, features, generator=generator, dtype=torch.float32) * scale
        self.register_buffer("directions", normal.to(torch.get_default_dtype()))

    def forward(self, points: Tensor) -> Tensor:
        turns = points.to(torch.float64) @ self.directions.to(torch.float64)
        return sin_cos_turns(turns, points.dtype)
