"""Raw output of a head -> density >= 0, or colour."""

import math
from typing import Any

import torch
from torch import Tensor, nn

from qnerf.config.registry import Registry
from qnerf.kernels import is_transformed
from qnerf.kernels.derivatives import clamped

DENSITY_ACTIVATIONS: Registry[Tensor] = Registry("density.activation")
COLOR_ACTIVATIONS: Registry[Tensor] = Registry("color.activation")

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


@DENSITY_ACTIVATIONS.register("trunc_exp")
def trunc_exp(x: Tensor) -> Tensor:
    """exp(x); the derivative is taken at x clamped to [-15, 15], so it neither vanishes nor overflows.

    >>> x = torch.tensor([20.0], requires_grad=True)
    >>> trunc_exp(x).backward()
    >>> x.grad.isclose(torch.tensor(15.0).exp())
    tensor([True])
    """
    return trunc_exp_reference(x) if is_transformed(x) else _TruncExp.apply(x)


def trunc_exp_reference(x: Tensor) -> Tensor:
    """`trunc_exp` made of PyTorch's own operations: beyond the bounds a straight line through the value."""
    at = x.detach()
    line = at.exp() + at.clamp(-_BOUND, _BOUND).exp() * (x - at).nan_to_num()  # infinity less infinity is 0 here
    return torch.where(at.abs() > _BOUND, line, clamped(x, -_BOUND, _BOUND).exp())


@DENSITY_ACTIVATIONS.register("softplus")
def softplus(x: Tensor) -> Tensor:
    """log(1 + exp(x)); above 40 it equals x to the last bit, also in float64."""
    return nn.functional.softplus(x, threshold=40.0)


@COLOR_ACTIVATIONS.register("sigmoid")
def sigmoid(x: Tensor) -> Tensor:
    """1 / (1 + exp(-x)): colours in (0, 1). The slope is at most 1/4."""
    return torch.sigmoid(x)


@COLOR_ACTIVATIONS.register("linear")
def linear(x: Tensor) -> Tensor:
    """x itself. Training compares it with the image as it is; evaluation clamps the rendered colour to [0, 1].

    This is the output of the published quantum colour head (github.com/yeray142/quantum-nerf).
    """
    return x


@COLOR_ACTIVATIONS.register("scaled")
def scaled(x: Tensor) -> Tensor:
    """sigmoid(4 x): colours in (0, 1), with the slope 1 at 0 that `linear` has."""
    return torch.sigmoid(4 * x)
