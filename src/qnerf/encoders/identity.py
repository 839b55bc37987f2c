"""No encoding: the coordinates themselves, or moved to [-1, 1]."""

from torch import Tensor

from qnerf.encoders.registry import ENCODERS, Encoder


@ENCODERS.register("none")
class Identity(Encoder):
    """The points themselves, (..., in_dim)."""

    trainable = False

    def __init__(self, in_dim: int) -> None:
        super().__init__(in_dim)
        self.out_dim = in_dim

    def forward(self, points: Tensor) -> Tensor:
        return points


@ENCODERS.register("signed")
class Signed(Identity):
    """Points of the unit cube moved to [-1, 1]: 2 x - 1, (..., in_dim)."""

    def forward(self, points: Tensor) -> Tensor:
        return 2 * points - 1
