"""The classical head."""

from collections.abc import Collection, Mapping
from itertools import pairwise
from typing import Any, Literal

import torch
from torch import Tensor, nn

from qnerf.config.bounds import Count, Depth
from qnerf.config.tensors import require_tensor
from qnerf.heads.base import HEADS, Head
from qnerf.kernels.dispatch import serves
from qnerf.kernels.mlp import Layer, mlp


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

    mixed = False
    """Whether all layers but the last multiply in bfloat16, in plain PyTorch; parameters and values keep theirs."""

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

    def as_layers(self) -> list[Layer] | None:
        """What a compiled loop takes of it; None unless these are linear layers with biases, and ReLU between them."""
        steps = list(self.net)
        linear = [layer for layer in steps[::2] if type(layer) is nn.Linear and layer.bias is not None]
        if len(linear) + sum(type(layer) is nn.ReLU for layer in steps[1::2]) < len(steps):
            return None
        return [Layer(layer.weight, layer.bias) for layer in linear]

    @classmethod
    def without_effect(cls, options: Mapping[str, Any]) -> Collection[str]:
        return ("width",) if options["layers"] == 1 else ()

    def in_loop(self, features: Tensor) -> list[Layer] | None:
        """The layers, if a compiled loop computes them on these features; None: the modules do."""
        layers = self.as_layers()
        but = "not linear layers with biases and ReLU between them" if layers is None else None
        but = "mixed precision" if self.mixed else but
        but = "autocast" if torch.is_autocast_enabled(features.device.type) else but
        if not serves("MLP", features, modules=(self,), but=but):
            return None
        assert layers is not None
        require_tensor("the features of an MLP", features, ("N", layers[0].weight.shape[1]))
        return layers

    def forward(self, features: Tensor) -> Tensor:
        """(N, in_dim) -> (N, out_dim)."""
        layers = self.in_loop(features)
        if layers is not None:
            return mlp(features, layers)
        if not self.mixed:
            values: Tensor = self.net(features)
            return values
        with torch.autocast(features.device.type, torch.bfloat16):
            hidden = self.net[:-1](features)
        last: Tensor = self.net[-1](hidden.to(features.dtype))
        return last
