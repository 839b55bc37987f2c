"""Raw output of the density head -> density >= 0."""

import math
from typing import Any

import torch
from torch import Tensor, nn

from qnerf.config.registry import Registry

ACTIVATIONS: Registry[Tensor] = Registry("activation")

_BOUND = 15.0  # on the argument of the derivative


class _TruncExp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        y = x.exp()
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (y,) = ctx.saved_tensors
        return grad * y.clamp(math.exp(-_BOUND), math.exp(_BOUND))


@ACTIVATIONS.register("trunc_exp")
def trunc_exp(x: Tensor) -> Tensor:
    """exp(x); the derivative is taken at x clamped to [-15, 15], so it neither vanishes nor overflows.

    >>> x = torch.tensor([20.0], requires_grad=True)
    >>> trunc_exp(x).backward()
    >>> x.grad == torch.tensor(15.0).exp()
    tensor([True])
    """
    return _TruncExp.apply(x)


@ACTIVATIONS.register("softplus")
def softplus(x: Tensor) -> Tensor:
    """log(1 + exp(x)); above 40 it equals x to the last bit, also in float64."""
    return nn.functional.softplus(x, threshold=40.0)
