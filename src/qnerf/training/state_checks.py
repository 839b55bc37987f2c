"""Whether a checkpoint is one of this run, before anything of it is loaded; and which value is not finite."""

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor


def check_shapes(name: str, values: Any, like: Mapping[Any, Tensor]) -> None:
    """ValueError unless these are tensors of the names, shapes and dtypes of `like`: compiled loops trust them."""
    if not isinstance(values, Mapping) or values.keys() != like.keys():
        raise ValueError(f"{name}: expected the names of this run's model")
    for key, one in like.items():
        value = values[key]
        got = (value.dtype, value.shape) if isinstance(value, Tensor) else type(value).__name__
        if got != (one.dtype, one.shape):
            raise ValueError(f"{name}.{key}: expected {one.dtype} {list(one.shape)}, got another tensor or none")


def first_non_finite(name: str, value: Any) -> str | None:
    """The name of a tensor in nested containers with a value that is not finite; None: there is none."""
    found = (path for path, tensor in _tensors(name, value) if not bool(torch.isfinite(tensor).all()))
    return next(found, None)


def _tensors(name: str, value: Any) -> Iterator[tuple[str, Tensor]]:
    if isinstance(value, Tensor):
        if value.is_floating_point():
            yield name, value.detach()
    elif isinstance(value, Mapping | list | tuple):
        for key, one in value.items() if isinstance(value, Mapping) else enumerate(value):
            yield from _tensors(f"{name}.{key}", one)
