"""No encoding."""

from torch import Tensor

from qnerf.encoders.registry import ENCODERS, Encoder


@ENCODERS.register("none")
class Identity(Encoder):
    """The points themselves, (..., in_dim)."""

    def __init__(self, in_dim: int) -> None:
        super().__init__(in_dim)
        self.out_dim = in_dim

    def forward(self, points: Tensor) -> Tensor:
        return points
