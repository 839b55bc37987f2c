"""Whether a component returned what it is to return."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


def require_tensor(what: object, value: Any, shape: Sequence[int | str], *dtypes: torch.dtype) -> Any:
    """The value, if it is a tensor of this shape and of one of these dtypes (none given: of any).

    Compiled loops trust the shapes of what they read. So everything that somebody else's component returns passes here
    first. A comparison takes a microsecond.

    Args:
        what: a component, or words, for the message.
        shape: sizes; a letter stands for any size.

    Raises:
        ValueError: one line that names `what`, what was expected and what came.
    """
    if isinstance(value, Tensor):
        sizes = [one if isinstance(wanted, str) else wanted for one, wanted in zip(value.shape, shape, strict=False)]
        if value.shape == (*sizes,) and len(sizes) == len(shape) and (not dtypes or value.dtype in dtypes):
            return value
    expected = " or ".join(map(str, dtypes)) or "a tensor"
    got = f"{value.dtype} {tuple(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
    name = what if isinstance(what, str) else f"what {getattr(what, '__name__', type(what).__name__)} returned"
    raise ValueError(f"{name}: expected {expected} ({', '.join(map(str, shape))}), got {got}".replace("torch.", ""))


def returned(component: object, value: Any, shape: Sequence[int | str], like: Tensor) -> Any:
    """`require_tensor` of what a component returned, in the dtype of what it was given; under autocast in any."""
    if isinstance(value, Tensor) and value.dtype == like.dtype and value.shape == shape:
        return value
    dtypes = () if torch.is_autocast_enabled(like.device.type) else (like.dtype,)
    return require_tensor(component, value, shape, *dtypes)
