"""What a compiled loop's backward pass does when its results are differentiated again; derivatives at bounds."""

from collections.abc import Callable, Sequence
from math import inf

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
    inputs: Sequence[Tensor],
    upstream: Tensor | tuple[Tensor, ...],
) -> list[Tensor | None]:
    """Gradients of `reference(*inputs)` that can be differentiated again; None for inputs that need none.

    A compiled backward pass is a constant to autograd. Second derivatives through it would be wrong.
    """
    with torch.enable_grad():
        own = [tensor.view_as(tensor) for tensor in inputs]  # one of the inputs may be made of another one
        needed = [tensor for tensor in own if tensor.requires_grad]
        out = reference(*own)
        if torch.is_tensor(out) and not out.requires_grad:  # it depends on none of them
            return [None] * len(own)
        gradients = torch.autograd.grad(out, needed, upstream, create_graph=True, allow_unused=True)
    found = iter(gradients)
    return [next(found) if tensor.requires_grad else None for tensor in inputs]
