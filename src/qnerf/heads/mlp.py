"""The classical head."""

from collections.abc import Collection, Mapping
from itertools import pairwise
from typing import Any, Literal

from torch import Tensor, nn

from qnerf.config.bounds import Count, Depth
from qnerf.heads.base import HEADS, Head
from qnerf.kernels.grid_mlp import Layer


@HEADS.register("mlp")
class MLPHead(Head):
    """A multilayer perceptron of `layers` linear layers, ReLU between them, nothing after the last.

    Args:
        in_dim, out_dim: features in and values out.
        layers: linear layers.
        width: hidden units.
        init: how the weights start. `torch`: PyTorch's default, which shrinks the spread of values by sqrt(6) a layer.
            `he`: normal with variance 2 / inputs, biases 0 (arXiv:1502.01852), which preserves the spread.

    >>> import torch
    >>> MLPHead(3, 4, layers=2, width=8)(torch.zeros(5, 3)).shape
    torch.Size([5, 4])
    """

    def __init__(
        self,
        in_dim: int,
        out_dim: int,
        *,
        layers: Depth = 2,
        width: Count = 64,
        init: Literal["torch", "he"] = "torch",
    ) -> None:
        super().__init__()
        dims = [in_dim, *[width] * (layers - 1), out_dim]
        steps: list[nn.Module] = []
        for before, after in pairwise(dims):
            steps += [nn.Linear(before, after), nn.ReLU(inplace=True)]
        self.net = nn.Sequential(*steps[:-1])
        if init == "he":
            for layer in self.net:
                if isinstance(layer, nn.Linear) and not layer.weight.is_meta:
                    nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
                    nn.init.zeros_(layer.bias)

    @classmethod
    def label(cls, options: Mapping[str, Any]) -> str:
        """`2x64`: layers x width."""
        return f"{options['layers']}x{options['width']}"

    def as_layers(self) -> tuple[Layer, Layer] | None:
        """The hidden and the last layer, for a loop that computes both; None unless there are two, with biases."""
        if [type(layer) for layer in self.net] != [nn.Linear, nn.ReLU, nn.Linear]:
            return None
        hidden, _, out = self.net
        if hidden.bias is None or out.bias is None:
            return None
        return Layer(hidden.weight, hidden.bias), Layer(out.weight, out.bias)  # type: ignore[arg-type]

    @classmethod
    def unread(cls, options: Mapping[str, Any]) -> Collection[str]:
        return ("width",) if options["layers"] == 1 else ()

    def forward(self, features: Tensor) -> Tensor:
        """(N, in_dim) -> (N, out_dim)."""
        return self.net(features)
