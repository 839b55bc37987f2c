"""A compiled loop and its plain PyTorch reference as one differentiable function."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from qnerf.kernels.derivatives import is_differentiated, through_reference
from qnerf.kernels.dispatch import serves


class Loop(NamedTuple):
    """Calls the compiled loop where `dispatch` lets it, else the reference. Both take the same inputs.

    Second derivatives come from the reference.
    """

    name: str
    """In `dispatch.LOOPS`."""
    reference: Callable[..., Any]
    """Inputs -> a tensor or several."""
    forward: Callable[..., tuple[Any, tuple[Any, ...]]]
    """Whether a backward pass follows, and the inputs -> what the reference returns, and what that pass needs."""
    backward: Callable[..., tuple[Tensor | None, ...]]
    """Which inputs need a gradient, the inputs, what `forward` kept, and a gradient of each output -> gradients of the
    first inputs; the others have none."""

    def __call__(self, *inputs: Any) -> Any:
        floats = [one for one in inputs if isinstance(one, Tensor) and one.is_floating_point()]
        return self.compiled(*inputs) if serves(self.name, *floats) else self.reference(*inputs)

    def compiled(self, *inputs: Any) -> Any:
        """The compiled loop, for inputs that it is known to serve."""
        if torch.is_grad_enabled() and any(isinstance(one, Tensor) and one.requires_grad for one in inputs):
            return _Compiled.apply(self, *inputs)
        return self.forward(False, *inputs)[0]


class _Compiled(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, loop: Loop, *inputs: Any) -> Any:
        outputs, kept = loop.forward(True, *inputs)
        saved = (*inputs, *kept)
        ctx.save_for_backward(*(one if isinstance(one, Tensor) else None for one in saved))
        ctx.others = [None if isinstance(one, Tensor) else one for one in saved]
        ctx.loop, ctx.count = loop, len(inputs)
        return outputs

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        saved = [other if one is None else one for one, other in zip(ctx.saved_tensors, ctx.others, strict=True)]
        inputs, kept = saved[: ctx.count], saved[ctx.count :]
        if is_differentiated(*upstream):
            return None, *through_reference(ctx.loop.reference, inputs, upstream)
        gradients = ctx.loop.backward(ctx.needs_input_grad[1:], inputs, kept, *upstream)
        return None, *gradients, *[None] * (ctx.count - len(gradients))
