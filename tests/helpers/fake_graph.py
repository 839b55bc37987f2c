"""CUDA graphs without CUDA: the operations of a step are recorded, and run again on the same tensors.

As on a GPU, recording changes no tensor and draws no random numbers, and whatever the host computed is frozen.
"""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import TorchDispatchMode

WAITS = (torch.Tag.data_dependent_output, torch.Tag.dynamic_output_shape)
INDEXED = (torch.ops.aten.index.Tensor, torch.ops.aten.index_put_.default, torch.ops.aten.index_put.default)

UNDECLARED = ("running_mean", "running_var")  # batch normalisation's schema does not say that it writes these


def waits(function: Any, args: Any) -> bool:
    """Whether the host waits for values of the operation: to read them, or to know a shape."""
    if function in INDEXED:
        return any(index is not None and index.dtype == torch.bool for index in args[1])
    return any(tag in function.tags for tag in WAITS)


class Tape(TorchDispatchMode):
    """Records the operations inside. They are computed meanwhile; `undo` puts back what they changed."""

    def __init__(self) -> None:
        super().__init__()
        self.done: list[tuple[Any, Any, Any, Any]] = []
        self.before: dict[int, tuple[Tensor, Tensor]] = {}

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if waits(function, args):
            raise RuntimeError("operation not permitted when stream is capturing")
        for argument, value in zip(function._schema.arguments, args, strict=False):
            written = argument.alias_info is not None and argument.alias_info.is_write
            if isinstance(value, Tensor) and (written or argument.name in UNDECLARED):
                self.before.setdefault(id(value), (value, value.clone()))
        out = function(*args, **kwargs)
        self.done.append((function, args, kwargs, out))
        return out

    @torch.no_grad()
    def undo(self) -> None:
        for value, before in reversed(self.before.values()):
            value.copy_(before)

    @torch.no_grad()
    def replay(self) -> None:
        for function, args, kwargs, out in self.done:
            found = function(*args, **kwargs)
            for old, new in zip(pytree.tree_leaves(out), pytree.tree_leaves(found), strict=True):
                if isinstance(old, Tensor) and old is not new and old.data_ptr() != new.data_ptr():
                    old.copy_(new)


class FakeCard:
    """In place of `qnerf.training.captured.Card`."""

    def on_stream(self) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    def record(self, call: Callable[[], None], generator: torch.Generator) -> Callable[[], None]:
        tape, state = Tape(), generator.get_state()
        try:
            with tape:
                call()
        finally:
            tape.undo()
            generator.set_state(state)
        return tape.replay


@contextlib.contextmanager
def plain_and_fixed(monkeypatch: Any) -> Iterator[None]:
    """A CPU that takes the paths of a GPU: plain PyTorch, shapes that do not depend on values."""
    from qnerf.kernels import dispatch
    from qnerf.model import chosen_rows

    with monkeypatch.context() as patch, dispatch.plain():
        patch.setattr(chosen_rows, "gathers", lambda mask: False)
        yield
