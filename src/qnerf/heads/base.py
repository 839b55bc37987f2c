"""The registry of heads. A head is a module (N, in_dim) -> (N, out_dim): HEADS.build(name, in_dim, out_dim)."""

from torch import nn

from qnerf.config.registry import Registry

HEADS: Registry[nn.Module] = Registry("head")
