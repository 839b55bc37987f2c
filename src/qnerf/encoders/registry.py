"""The base class of encoders and their registry."""

from typing import ClassVar

from torch import Tensor, nn

from qnerf.config import bounds
from qnerf.config.registry import Registry
from qnerf.config.tensors import returned


class Encoder(nn.Module):
    """Points (..., in_dim) in the unit cube -> features (..., out_dim), in the points' dtype."""

    trainable: ClassVar[bool] = True
    """Whether it has parameters; where not, no learning rate acts on it."""
    in_dim: int
    out_dim: int

    def __init__(self, in_dim: int) -> None:
        super().__init__()
        bounds.check("in_dim", in_dim, bounds.PositiveInt)
        self.in_dim = in_dim

    def __call__(self, points: Tensor) -> Tensor:
        return returned(self, super().__call__(points), (*points.shape[:-1], self.out_dim), points)

    def forward(self, points: Tensor) -> Tensor:
        raise NotImplementedError


ENCODERS: Registry[Encoder] = Registry("encoder")
