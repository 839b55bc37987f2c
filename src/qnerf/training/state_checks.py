"""Checks of what a checkpoint holds, all of them before anything is loaded.

A checkpoint may be damaged or come from anybody. Kernels trust their tensors: with a moment of the wrong shape, a fused
optimiser would read and write outside it.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

CUDA_STREAM = 16  # bytes of the state of a random generator on CUDA


def check_like(name: str, value: Any, like: Any) -> None:
    """ValueError unless `value` has the keys, types, shapes and dtypes of `like`, and all its numbers are finite.

    Tensors must lie in CPU memory. A float may be infinite where that of `like` is.
    """
    if isinstance(like, Tensor):
        _check_tensor(name, value, like)
        return
    if type(value) is not type(like) and not (isinstance(value, dict) and isinstance(like, dict)):
        raise ValueError(f"{name}: expected {type(like).__name__}, got {type(value).__name__}")
    if isinstance(like, dict):
        if different := like.keys() ^ value.keys():
            kind = "lacks" if different & like.keys() else "has the unknown key"
            shown = sorted(map(str, different & like.keys() or different))
            raise ValueError(f"{name}: {kind} {', '.join(shown)[:100]}")
        for key, one in like.items():
            check_like(f"{name}.{key}", value[key], one)
    elif isinstance(like, float) and value != value:
        raise ValueError(f"{name}: expected a number, got nan")


def _check_tensor(name: str, value: Any, like: Tensor) -> None:
    if type(value) is not Tensor:
        raise ValueError(f"{name}: expected a tensor, got {type(value).__name__}")
    if value.layout != torch.strided or value.is_nested or value.device.type != "cpu":
        raise ValueError(f"{name}: expected an ordinary tensor, got one that is sparse, nested or empty")
    if value.shape != like.shape or value.dtype != like.dtype:
        expected, got = (f"{str(one.dtype)[6:]} of shape {list(one.shape)}" for one in (like, value))
        raise ValueError(f"{name}: expected {expected}, got {got}")
    if not bool(torch.isfinite(value).all()):
        raise ValueError(f"{name}: not finite")


def check_optimiser(state: Any, parameters: Mapping[int, Tensor], kept: Mapping[str, bool]) -> None:
    """ValueError unless `state` is what an optimiser keeps: number of a parameter -> key -> tensor.

    kept: as of `kept_of_a_parameter`. A parameter that never had a gradient has no entry.
    """
    if not isinstance(state, dict) or not state.keys() <= parameters.keys():
        raise ValueError("optimiser: expected a dict with the state of each parameter of this run")
    number = torch.zeros(())
    for index, own in state.items():
        like = {key: parameters[index] if whole else number for key, whole in kept.items()}
        check_like(f"optimiser.{index}", own, like)


def check_integer(name: str, value: Any, lowest: int, highest: int) -> None:
    """ValueError unless `value` is an integer from `lowest` to `highest`."""
    if type(value) is not int or not lowest <= value <= highest:
        shown = value if type(value) in (int, float) else type(value).__name__
        raise ValueError(f"{name}: expected an integer from {lowest} to {highest}, got {shown}")


def check_stream(name: str, value: Any, own: torch.Generator) -> None:
    """ValueError unless `value` is the state of a random generator, of this device or of another kind of device."""
    sizes = (len(own.get_state()), len(torch.Generator().get_state()), CUDA_STREAM)
    if type(value) is not Tensor or value.dtype != torch.uint8 or value.dim() != 1 or len(value) not in sizes:
        raise ValueError(f"{name}: expected the state of a random generator")
    if len(value) == sizes[0]:
        try:
            torch.Generator(own.device).set_state(value)
        except RuntimeError:
            raise ValueError(f"{name}: not the state of a random generator") from None


def first_non_finite(name: str, value: Any) -> str | None:
    """The name of a tensor in nested containers with a value that is not finite; None: there is none."""
    found = (path for path, tensor in tensors(name, value) if not bool(torch.isfinite(tensor).all()))
    return next(found, None)


def tensors(name: str, value: Any) -> Iterator[tuple[str, Tensor]]:
    """The tensors of floats in nested containers and data classes, each with its name."""
    if isinstance(value, Tensor):
        if value.is_floating_point():
            yield name, value.detach()
    elif isinstance(value, Mapping):
        for key, one in value.items():
            yield from tensors(f"{name}.{key}", one)
    elif isinstance(value, list | tuple):
        for number, one in enumerate(value):
            yield from tensors(f"{name}.{number}", one)
    elif hasattr(value, "__dataclass_fields__"):
        yield from tensors(name, vars(value))
