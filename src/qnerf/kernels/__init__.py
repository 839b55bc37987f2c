"""Compiled CPU loops. Each has a plain PyTorch reference, and tests that both agree."""

import contextlib
from collections.abc import Iterator

import torch
from torch import Tensor, nn

_HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")
_GLOBAL_HOOKS = [getattr(nn.modules.module, f"_global{hooks}") for hooks in _HOOKS]

_plain = False


def compiled(*tensors: Tensor) -> bool:
    """Whether the compiled loops take these tensors: on the CPU, all float32 or all float64, and not inside `plain`."""
    dtype = tensors[0].dtype
    known = dtype in (torch.float32, torch.float64)
    return known and not _plain and all(t.device.type == "cpu" and t.dtype == dtype for t in tensors)


def replaceable(*modules: nn.Module) -> bool:
    """Whether a loop may compute what these modules do without calling them: none has a hook or another `forward`."""
    if any(_GLOBAL_HOOKS):
        return False
    parts = [part for module in modules for part in module.modules()]
    return not any("forward" in vars(part) or any(getattr(part, hooks) for hooks in _HOOKS) for part in parts)


@contextlib.contextmanager
def plain() -> Iterator[None]:
    """Inside, every compiled loop is replaced by its plain PyTorch reference. Tests and benchmarks compare with it."""
    global _plain
    before, _plain = _plain, True
    try:
        yield
    finally:
        _plain = before
