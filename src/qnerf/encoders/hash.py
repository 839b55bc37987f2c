"""Multiresolution hash encoding as a module: the table and its level resolutions."""

import math
from typing import Annotated

import torch
from annotated_types import Interval
from torch import Tensor, nn

from qnerf.encoders.registry import ENCODERS, Encoder
from qnerf.kernels.grid_mlp import Grid
from qnerf.kernels.hashgrid import FINEST, hash_encode

Levels = Annotated[int, Interval(ge=1, le=64)]
Resolution = Annotated[int, Interval(ge=1, le=FINEST)]
Log2Size = Annotated[int, Interval(ge=1, le=30)]
EntryFeatures = Annotated[int, Interval(ge=1, le=256)]


def level_resolutions(levels: int, min_resolution: int, max_resolution: int) -> list[int]:
    """Cells along a side: floor(min growth^l), growth = exp((ln max - ln min) / (levels - 1)).

    Eq. 2 and 3, arXiv:2201.05989. Products within 1e-6 of an integer are rounded to it: plain float64 would make the
    last level of 16 -> 128 a grid of 127 cells.

    >>> level_resolutions(4, min_resolution=16, max_resolution=128)
    [16, 32, 64, 128]
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
    """Features interpolated from grids of growing resolution: (..., levels x features).

    Points with fewer than 3 coordinates lie on the planes where the others are 0, so their grids have fewer dimensions.

    Args:
        levels: number of grids.
        min_resolution, max_resolution: cells along a side of the coarsest and of the finest grid.
        log2_table_size: log2 of the entries that one level may have.
        features: numbers per entry.
        dense: whether levels whose whole grid fits into their table are indexed directly, without collisions.

    The table (levels, 2^log2_table_size, features) starts from U(-1e-3, 1e-3), drawn with `generator` (default:
    PyTorch's global one).
    """

    resolutions: Tensor

    def __init__(
        self,
        in_dim: int,
        generator: torch.Generator | None = None,
        *,
        levels: Levels = 12,
        min_resolution: Resolution = 16,
        max_resolution: Resolution = 1024,
        log2_table_size: Log2Size = 15,
        features: EntryFeatures = 1,
        dense: bool = True,
    ) -> None:
        super().__init__(in_dim)
        if in_dim > 3:
            raise ValueError(f"encoder=hash: points must have at most 3 coordinates, got {in_dim}")
        if min_resolution > max_resolution:
            raise ValueError(f"max_resolution must be at least min_resolution={min_resolution}, got {max_resolution}")
        self.out_dim = levels * features
        self.dense = dense
        resolutions = torch.tensor(level_resolutions(levels, min_resolution, max_resolution))
        self.register_buffer("resolutions", resolutions, persistent=False)
        self.table = nn.Parameter(torch.empty(levels, 2**log2_table_size, features))
        nn.init.uniform_(self.table, -1e-3, 1e-3, generator=generator)

    def as_grid(self) -> Grid:
        """The encoder of points in space in one loop with an MLP."""
        return Grid(self.table, self.resolutions, self.dense)

    def forward(self, points: Tensor) -> Tensor:
        flat = points.reshape(-1, self.in_dim)
        if self.in_dim < 3:
            flat = nn.functional.pad(flat, (0, 3 - self.in_dim))
        encoded = hash_encode(flat, self.table, self.resolutions, self.dense)
        return encoded.view(*points.shape[:-1], self.out_dim)
