"""A layer as one opaque operator: what `torch.compile` sees of it.

The engines work on NumPy arrays, which a compiler cannot follow. It needs only the shape of the result and the
gradients, which are computed by running the layer again.
"""

import itertools
from collections.abc import Sequence
from typing import Any, Protocol
from weakref import WeakValueDictionary

import torch
from torch import Tensor


class Evaluator(Protocol):
    """What an operator runs."""

    @property
    def outputs(self) -> int: ...

    def evaluate(self, x: Tensor, weights: Tensor) -> Tensor:
        """Outputs (B, outputs) for inputs (B, features) in radians and flat weights."""
        ...


_evaluators: WeakValueDictionary[int, Any] = WeakValueDictionary()
_numbers = itertools.count()


def register(evaluator: Evaluator) -> int:
    """The number under which the operator finds the evaluator, for as long as the evaluator lives."""
    number = next(_numbers)
    _evaluators[number] = evaluator
    return number


def _as_outside() -> Any:
    """Inside an operator PyTorch's own operations are not recorded for autograd, and lose complex conjugates.

    In this context they are what they are outside.
    """
    keys = torch._C
    return keys._ForceDispatchKeyGuard(
        keys._dispatch_tls_local_include_set(), keys.DispatchKeySet(keys.DispatchKey.Undefined)
    )


@torch.library.custom_op("qnerf::circuit", mutates_args=())
def evaluate(x: Tensor, weights: Tensor, number: int) -> Tensor:
    """`Evaluator.evaluate` of the evaluator with this number, differentiable once."""
    with torch.no_grad(), _as_outside():
        out: Tensor = _evaluators[number].evaluate(x, weights)
    return out


@evaluate.register_fake
def _(x: Tensor, weights: Tensor, number: int) -> Tensor:
    return x.new_empty(x.shape[0], _evaluators[number].outputs)


@torch.library.custom_op("qnerf::circuit_gradients", mutates_args=())
def _gradients(gradient: Tensor, x: Tensor, weights: Tensor, number: int) -> tuple[Tensor, Tensor]:
    with torch.enable_grad(), _as_outside():
        inputs = x.detach().requires_grad_(), weights.detach().requires_grad_()
        out = _evaluators[number].evaluate(*inputs)
    of_x, of_weights = torch.autograd.grad(out, inputs, gradient)
    return of_x, of_weights


@_gradients.register_fake
def _(gradient: Tensor, x: Tensor, weights: Tensor, number: int) -> tuple[Tensor, Tensor]:
    return torch.empty_like(x), torch.empty_like(weights)


def _keep(ctx: Any, inputs: Sequence[Any], output: Tensor) -> None:
    x, weights, ctx.number = inputs
    ctx.save_for_backward(x, weights)


def _backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
    return *_gradients(gradient, *ctx.saved_tensors, ctx.number), None


evaluate.register_autograd(_backward, setup_context=_keep)
