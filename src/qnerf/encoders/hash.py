"""Multiresolution hash encoding as a module: the table and its level resolutions."""

import math

import torch
from torch import Tensor, nn

from qnerf.config.checks import at_least, between
from qnerf.encoders.frequency_window import window_weights
from qnerf.encoders.registry import ENCODERS, Encoder
from qnerf.kernels.hashgrid import FINEST, hash_encode

LARGEST = 30  # log2 of the entries of a level


def level_resolutions(levels: int, min_resolution: int, max_resolution: int) -> list[int]:
    """Cells along a side: floor(min growth^l), growth = exp((ln max - ln min) / (levels - 1)).

    Eq. 2 and 3, arXiv:2201.05989. Exact where the product is an integer, at both ends above all: float64 alone makes
    127 of the last level of 16 -> 128.
    """
    if levels == 1:
        return [min_resolution]
    growth = math.exp((math.log(max_resolution) - math.log(min_resolution)) / (levels - 1))
    resolutions = []
    for level in range(levels):
        exact = min_resolution * growth**level
        nearest = round(exact)
        resolutions.append(nearest if abs(exact - nearest) < 1e-6 else math.floor(exact))
    return resolutions


@ENCODERS.register("hash")
class HashEncoder(Encoder):
    """Features of the points' cells on grids of growing resolution: (..., levels x features).

    Args:
        levels: number of grids.
        min_resolution, max_resolution: cells along a side of the coarsest and of the finest grid.
        log2_table_size: log2 of the entries that one level may have.
        features: numbers an entry.
        dense: whether levels whose whole grid fits into their table are indexed directly, without collisions.
        frequency_window: share of the training until the finest level enters (`window_weights`); 0: all from the start.

    The table (levels, 2^log2_table_size, features) starts as U(-1e-3, 1e-3), from `generator` (default: PyTorch's own).
    """

    resolutions: Tensor

    def __init__(
        self,
        in_dim: int,
        generator: torch.Generator | None = None,
        *,
        levels: int = 12,
        min_resolution: int = 16,
        max_resolution: int = 1024,
        log2_table_size: int = 15,
        features: int = 1,
        dense: bool = True,
        frequency_window: float = 0.0,
    ) -> None:
        super().__init__(in_dim)
        if in_dim != 3:
            raise ValueError(f"encoder=hash: points must have 3 coordinates, got {in_dim}")
        at_least("levels", levels, 1)
        at_least("features", features, 1)
        between("frequency_window", frequency_window, 0, 1)
        at_least("min_resolution", min_resolution, 1)
        if not min_resolution <= max_resolution <= FINEST:
            raise ValueError(
                f"encoder=hash: max_resolution must be between min_resolution={min_resolution} and {FINEST}, "
                f"got {max_resolution}"
            )
        if not 1 <= log2_table_size <= LARGEST:
            raise ValueError(f"encoder=hash: log2_table_size must be 1 to {LARGEST}, got {log2_table_size}")
        self.out_dim = levels * features
        self.dense = dense
        self.frequency_window = frequency_window
        resolutions = torch.tensor(level_resolutions(levels, min_resolution, max_resolution))
        self.register_buffer("resolutions", resolutions, persistent=False)
        self.table = nn.Parameter(torch.empty(levels, 2**log2_table_size, features))
        nn.init.uniform_(self.table, -1e-3, 1e-3, generator=generator)

    def forward(self, points: Tensor) -> Tensor:
        encoded = hash_encode(points.reshape(-1, 3), self.table, self.resolutions, self.dense)
        weights = window_weights(len(self.table), self.progress, self.frequency_window)
        if weights is not None:
            encoded = encoded * weights.to(encoded).repeat_interleave(self.table.shape[-1])
        return encoded.view(*points.shape[:-1], self.out_dim)
