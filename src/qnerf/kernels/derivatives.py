"""What a compiled loop's backward pass does when its results are differentiated again; derivatives at bounds."""

from collections.abc import Callable, Sequence
from math import inf
from typing import Any

import torch
from torch import Tensor

from qnerf.kernels.dispatch import is_transformed


def is_differentiated(*upstream: Tensor) -> bool:
    """Whether a backward pass has to be differentiable itself: `create_graph=True`, or transformed gradients.

    Gradients that autograd batches with a vmap of its own (`is_grads_batched=True`) count as such.
    """
    if torch.is_grad_enabled() or is_transformed(*upstream):
        return True
    return not torch.compiler.is_compiling() and any(map(torch._C._functorch.is_legacy_batchedtensor, upstream))


def clamped(x: Tensor, low: float = -inf, high: float = inf) -> Tensor:
    """x.clamp(low, high), with the derivative 1 at the bounds. PyTorch's own has 1 there up to version 2.13, then 0."""
    bounded = x.detach().clamp(low, high)
    return torch.where(x == bounded, x, bounded)


def through_reference(
    reference: Callable[..., Tensor | tuple[Tensor, ...]],
    inputs: Sequence[Any],
    upstream: Tensor | tuple[Tensor, ...],
) -> list[Tensor | None]:
    """Gradients of `reference(*inputs)` that can be differentiated again; None for inputs that need none.

    A compiled backward pass is a constant to autograd. Second derivatives through it would be wrong.
    """
    with torch.enable_grad():
        # One of the inputs may be made of another one.
        own = [one.view_as(one) if isinstance(one, Tensor) else one for one in inputs]
        needs = [isinstance(one, Tensor) and one.requires_grad for one in own]
        needed = [one for one, needs_one in zip(own, needs, strict=True) if needs_one]
        out = reference(*own)
        if torch.is_tensor(out) and not out.requires_grad:  # it depends on none of them
            return [None] * len(own)
        gradients = torch.autograd.grad(out, needed, upstream, create_graph=True, allow_unused=True)
    found = iter(gradients)
    return [next(found) if needs_one else None for needs_one in needs]
