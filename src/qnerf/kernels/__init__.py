"""Compiled CPU loops. Each has a plain PyTorch reference, and tests that both agree."""

import contextlib
from collections.abc import Iterator

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

_HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")
_GLOBAL_HOOKS = [getattr(nn.modules.module, f"_global{hooks}") for hooks in _HOOKS]

_plain = False


def compiled(*tensors: Tensor) -> bool:
    """Whether the compiled loops take these tensors: on the CPU, all float32 or all float64, and neither inside `plain`
    nor inside a transformation (see `is_transformed`).
    """
    dtype = tensors[0].dtype
    if _plain or dtype not in (torch.float32, torch.float64) or is_transformed(*tensors):
        return False
    return all(tensor.device.type == "cpu" and tensor.dtype == dtype for tensor in tensors)


def is_transformed(*tensors: Tensor) -> bool:
    """Whether `torch.func` is at work in this thread, or a tensor has a tangent of forward-mode differentiation.

    Both follow only PyTorch's own operations. `torch.no_grad` stops neither of them; `detach` does.
    """
    if torch._C._are_functorch_transforms_active():
        return True
    return forward_ad._current_level >= 0 and any(forward_ad.unpack_dual(t).tangent is not None for t in tensors)


def replaceable(*modules: nn.Module) -> bool:
    """Whether a loop may compute what these modules do without calling them: none has a hook or another `forward`."""
    return not any(_GLOBAL_HOOKS) and all(map(_unwatched, modules))


def _unwatched(module: nn.Module) -> bool:
    own = vars(module)
    if "forward" in own or any(own[hooks] for hooks in _HOOKS):
        return False
    return all(map(_unwatched, module.children()))


@contextlib.contextmanager
def plain() -> Iterator[None]:
    """Inside, every compiled loop is replaced by its plain PyTorch reference. Tests and benchmarks compare with it."""
    global _plain
    before, _plain = _plain, True
    try:
        yield
    finally:
        _plain = before
