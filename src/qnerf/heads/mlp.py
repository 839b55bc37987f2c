"""The classical head."""

from torch import Tensor, nn

from qnerf.heads.base import HEADS, at_least


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
        at_least(1, layers=layers, width=width)
        dims = [in_dim, *[width] * (layers - 1), out_dim]
        steps: list[nn.Module] = []
        for before, after in zip(dims[:-1], dims[1:], strict=True):
            steps += [nn.Linear(before, after), nn.ReLU(inplace=True)]
        self.net = nn.Sequential(*steps[:-1])

    def forward(self, features: Tensor) -> Tensor:
        """(N, in_dim) -> (N, out_dim)."""
        return self.net(features)
