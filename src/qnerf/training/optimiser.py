"""The optimiser of a training."""

from typing import Any

import torch

from qnerf.config.settings import Schedule
from qnerf.kernels.jit import one_torch_thread

MANY = 2**22
"""From so many numbers on, several threads of PyTorch's pay."""


def build_optimiser(groups: list[dict[str, Any]], train: Schedule) -> torch.optim.Optimizer:
    """The optimiser of these groups of parameters, with the options of the recipe. Nothing else names its kind."""
    beta1, beta2 = train.betas
    return torch.optim.Adam(groups, lr=train.lr, betas=(beta1, beta2), eps=train.eps, fused=True)


def apply_gradients(optimiser: torch.optim.Optimizer) -> None:
    """A step of the optimiser, on one thread of PyTorch's unless it changes many numbers."""
    numbers = sum(one.numel() for group in optimiser.param_groups for one in group["params"])
    with one_torch_thread(numbers < MANY):
        optimiser.step()


def forget_gradients(optimiser: torch.optim.Optimizer) -> None:
    """What `zero_grad` does; the decorators around that one take longer than all else."""
    for group in optimiser.param_groups:
        for parameter in group["params"]:
            parameter.grad = None
