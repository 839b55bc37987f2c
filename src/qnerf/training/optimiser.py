"""The optimiser of a training."""

from typing import Any

import torch
from torch import Tensor, nn

from qnerf.config.settings import Schedule


def build_optimiser(groups: list[dict[str, Any]], train: Schedule) -> torch.optim.Optimizer:
    """The optimiser of these groups of parameters, with the options of the recipe. Nothing else names its kind."""
    return torch.optim.Adam(groups, lr=train.lr, eps=train.eps, fused=True)


def kept_of_a_parameter(train: Schedule) -> dict[str, bool]:
    """What the optimiser keeps of each parameter after its first step: key -> whether it has the parameter's shape.

    The rest are single numbers.
    """
    parameter = nn.Parameter(torch.zeros(2, 3))
    optimiser = build_optimiser([{"params": [parameter], "name": "any"}], train)
    parameter.grad = torch.zeros_like(parameter)
    optimiser.step()
    kept: dict[str, Tensor] = optimiser.state[parameter]
    return {key: value.shape == parameter.shape for key, value in kept.items()}
