"""The optimiser of a training."""

from typing import Any

import torch
from torch import nn

from qnerf.config.settings import Schedule
from qnerf.kernels.adam import Update, adam
from qnerf.kernels.dispatch import serves


def build_optimiser(groups: list[dict[str, Any]], train: Schedule) -> torch.optim.Optimizer:
    """The optimiser of these groups of parameters, with the options of the recipe. Nothing else names its kind."""
    beta1, beta2 = train.betas
    return torch.optim.Adam(groups, lr=train.lr, betas=(beta1, beta2), eps=train.eps, fused=True)


@torch.no_grad()
def apply_gradients(optimiser: torch.optim.Optimizer) -> None:
    """A step of the optimiser; Adam's is a compiled loop where one serves."""
    changed = [(group, one) for group in optimiser.param_groups for one in group["params"] if one.grad is not None]
    but = None if type(optimiser) is torch.optim.Adam else type(optimiser).__name__
    if optimiser._optimizer_step_pre_hooks or optimiser._optimizer_step_post_hooks:
        but = "hooks on the optimiser"
    if not all(one.is_contiguous() and one.grad.is_contiguous() for _, one in changed):
        but = "parameters in another order in memory"
    if changed and serves("Adam", *(one for _, one in changed), but=but):
        _adam(optimiser, changed)
    else:
        optimiser.step()


def forget_gradients(optimiser: torch.optim.Optimizer) -> None:
    """What `zero_grad` does; the decorators around that one take longer than all else."""
    for group in optimiser.param_groups:
        for parameter in group["params"]:
            parameter.grad = None


def _adam(optimiser: torch.optim.Optimizer, changed: list[tuple[dict[str, Any], nn.Parameter]]) -> None:
    beta1, beta2 = optimiser.defaults["betas"]
    states = [optimiser.state[one] for _, one in changed]
    for (_, one), state in zip(changed, states, strict=True):
        if not state:
            state |= {"step": torch.zeros(())} | {key: torch.zeros_like(one) for key in ("exp_avg", "exp_avg_sq")}
    updates = []
    for (group, one), state in zip(changed, states, strict=True):
        steps = state["step"].numpy()  # the same memory: an operation of PyTorch would take longer
        steps += 1
        step = float(steps)
        tensors = (one, one.grad, state["exp_avg"], state["exp_avg_sq"])
        updates.append(Update(tensors, group["lr"] / (1 - beta1**step), (1 - beta2**step) ** -0.5))  # type: ignore[arg-type]
    adam(updates, beta1, beta2, optimiser.defaults["eps"])
