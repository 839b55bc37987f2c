"""The registry of heads. A head is a module (N, in_dim) -> (N, out_dim), built as HEADS.build(name, in_dim, out_dim)."""

from torch import nn

from qnerf.registry import Registry

HEADS: Registry[nn.Module] = Registry("head")


def at_least(least: int, **values: int) -> None:
    """ValueError unless every value is at least `least`."""
    for name, value in values.items():
        if value < least:
            raise ValueError(f"{name} must be at least {least}, got {value}")
