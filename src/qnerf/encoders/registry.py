"""The group `encoder`, and what its members have in common."""

from torch import Tensor, nn

from qnerf.registry import Registry


class Encoder(nn.Module):
    """Points (..., in_dim) in the unit cube -> features (..., out_dim), in the points' dtype."""

    in_dim: int
    out_dim: int

    def __init__(self, in_dim: int) -> None:
        super().__init__()
        if in_dim < 1:
            raise ValueError(f"encoder: in_dim must be 1 or more, got {in_dim}")
        self.in_dim = in_dim

    def forward(self, points: Tensor) -> Tensor:
        raise NotImplementedError


ENCODERS: Registry[Encoder] = Registry("encoder")


def at_least(name: str, value: float, least: float) -> None:
    """ValueError where an encoder's option is too small or not a number."""
    if not least <= value < float("inf"):
        raise ValueError(f"encoder: {name} must be {least} or more, got {value}")
