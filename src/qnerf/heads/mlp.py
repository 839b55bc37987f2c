"""The classical head."""

from itertools import pairwise

from torch import Tensor, nn

from qnerf.checks import at_least
from qnerf.heads.base import HEADS


@HEADS.register("mlp")
class MLPHead(nn.Module):
    """A multilayer perceptron of `layers` linear layers, ReLU between them, nothing after the last.

    Args:
        in_dim, out_dim: features in and values out.
        layers: linear layers, at least 1.
        width: hidden units, at least 1.
    """

    def __init__(self, in_dim: int, out_dim: int, *, layers: int = 2, width: int = 64) -> None:
        super().__init__()
        at_least("layers", layers, 1)
        at_least("width", width, 1)
        dims = [in_dim, *[width] * (layers - 1), out_dim]
        steps: list[nn.Module] = []
        for before, after in pairwise(dims):
            steps += [nn.Linear(before, after), nn.ReLU(inplace=True)]
        self.net = nn.Sequential(*steps[:-1])

    def forward(self, features: Tensor) -> Tensor:
        """(N, in_dim) -> (N, out_dim)."""
        return self.net(features)
