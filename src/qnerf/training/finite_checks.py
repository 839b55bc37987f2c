"""Names the first value of a training step that is not finite (`numerics.finite_checks=true`).

Hooks look at what each module takes and returns, in the order of the flow, at each gradient on the way back, and at the
parameters after the update. A module with a hook is called, so no compiled loop stands for it: numbers may differ by
rounding.
"""

from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from qnerf.rendering.proposal_sampler import ProposalNetwork
from qnerf.training.state_checks import tensors
from qnerf.training.trainer import Diverged, Loop

UNBOUNDED = (ProposalNetwork,)
"""Modules that return a density: it may be infinite, as volume rendering is defined for it. NaN is never allowed."""


def check_every_value(trainer: Loop) -> None:
    """From now on the trainer raises `Diverged` at the first value of a step that is not finite."""
    model: nn.Module = trainer.model

    def check(where: str, value: Any, infinite: bool = False) -> None:
        if not model.training:
            return
        for name, tensor in tensors(where, value):
            wrong = tensor.isnan() if infinite else ~torch.isfinite(tensor)
            if bool(wrong.any()):
                first = float(tensor[wrong][0])
                count = f"{int(wrong.sum())} of {wrong.numel()} values"
                raise Diverged(f"{first} in {name}, {count}, at step {trainer.step}")

    def taken(module: nn.Module, inputs: Any, where: str) -> None:
        check(f"the inputs of {where}", inputs[0] if len(inputs) == 1 else inputs)

    def returned(module: nn.Module, inputs: Any, output: Any, where: str) -> None:
        check(f"the outputs of {where}", output, isinstance(module, UNBOUNDED))

    def accumulated(parameter: Tensor, where: str) -> None:
        check(f"the gradient of {where}", parameter.grad)

    def updated(*_: object) -> None:
        for name, parameter in model.named_parameters():
            check(f"{name} after the update", parameter)

    for name, module in model.named_modules():
        module.register_forward_pre_hook(partial(taken, where=name or "the model"))
        module.register_forward_hook(partial(returned, where=name or "the model"))
    for name, parameter in model.named_parameters():
        parameter.register_post_accumulate_grad_hook(partial(accumulated, where=name))
    trainer.optimiser.register_step_post_hook(updated)
