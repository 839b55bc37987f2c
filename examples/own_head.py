"""A head of one's own, in a module of one's own: a network of products beside qnerf's heads.

    cd examples
    qnerf run plugins=[own_head] color=products density=mlp

The class is all: its keyword-only parameters are the options of `color.products` (or `density.products`), with the
types and bounds of their annotations. `qnerf run` checks them, hashes them to the run's id and makes columns of them:

    qnerf run -m plugins=[own_head] density=mlp color=products,mlp color.products.rank=4,16 seed=0,1,2
    qnerf tables runs --rows color
"""

from collections.abc import Mapping
from typing import Annotated, Any

import torch
from annotated_types import Interval
from torch import Tensor, nn

from qnerf.heads import HEADS, Head


@HEADS.register("products")
class Products(Head):
    """The sum of `rank` products of `factors` linear maps of the features, each through a tanh.

    Args:
        in_dim, out_dim: features and values; the code that builds the field gives them.
        rank: number of products.
        factors: linear maps in each product.
        sharpness: factor on what goes into each tanh.
    """

    def __init__(
        self,
        in_dim: int,
        out_dim: int,
        *,
        rank: Annotated[int, Interval(ge=1, le=512)] = 16,
        factors: Annotated[int, Interval(ge=1, le=8)] = 2,
        sharpness: Annotated[float, Interval(gt=0, le=100)] = 1.0,
    ) -> None:
        super().__init__()
        self.maps = nn.ModuleList(nn.Linear(in_dim, rank) for _ in range(factors))
        self.readout = nn.Linear(rank, out_dim)
        self.sharpness = sharpness

    @classmethod
    def label(cls, options: Mapping[str, Any]) -> str:
        """What a run is called: `products16x2`."""
        return f"products{options['rank']}x{options['factors']}"

    def forward(self, features: Tensor) -> Tensor:
        """(N, in_dim) -> (N, out_dim)."""
        factors = torch.stack([torch.tanh(self.sharpness * own(features)) for own in self.maps])
        out: Tensor = self.readout(factors.prod(0))
        return out
