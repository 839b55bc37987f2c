"""Raw network output -> density."""

import math
from typing import Any

import torch
from torch import Tensor, nn

from qnerf.config.registry import Registry

ACTIVATIONS: Registry[Tensor] = Registry("activation")

_BOUND = 15.0


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
    """exp(x), whose derivative is taken at x clamped to [-15, 15] so that it neither vanishes nor overflows."""
    return _TruncExp.apply(x)


@ACTIVATIONS.register("softplus")
def softplus(x: Tensor) -> Tensor:
    """log(1 + exp(x)); beyond 40 it is x to the last bit, in float64 too."""
    return nn.functional.softplus(x, threshold=40.0)
