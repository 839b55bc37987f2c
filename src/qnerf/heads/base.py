"""The base class of heads and their registry."""

from collections.abc import Collection, Mapping
from typing import Any

from torch import Tensor, nn

from qnerf.config.registry import Registry
from qnerf.config.tensors import returned

MIN_BATCH = 2  # samples that a head must get in training: batch normalisation needs two


class Head(nn.Module):
    """Features (N, in_dim) -> values (N, out_dim), built by `HEADS.build(name, in_dim, out_dim, **options)`."""

    quantum = False
    """Whether the field's label counts the head as a circuit."""
    recipe = "mlp"
    """The built-in head whose rates, initial density and colour activation this head gets from a recipe (conf/train),
    unless the configuration names this head itself."""
    out_dim: int = 0
    """Set by `HEADS.build`; 0: not known."""

    def __call__(self, features: Tensor) -> Tensor:
        values = super().__call__(features)
        return returned(self, values, (*features.shape[:-1], self.out_dim or "out_dim"), features)

    @classmethod
    def label(cls, options: Mapping[str, Any]) -> str:
        """A short name of the head with these options; by default the name that it is registered under."""
        return HEADS.name_of(cls) or cls.__name__

    @classmethod
    def without_effect(cls, options: Mapping[str, Any]) -> Collection[str]:
        """The options that do not act, given the values of all of them."""
        return ()

    def forward(self, features: Tensor) -> Tensor:
        raise NotImplementedError


class _Heads(Registry[Head]):
    def build_checked(self, name: str, /, *wiring: Any, **options: Any) -> Head:
        head = super().build_checked(name, *wiring, **options)
        head.out_dim = wiring[1]
        return head


HEADS = _Heads("head")


def chosen(node: Mapping[str, Any]) -> type[Head]:
    """The class of the head that `node` (the group density or color) names."""
    head = HEADS.get(node["name"])
    assert isinstance(head, type)
    return head


def head_options(node: Mapping[str, Any]) -> dict[str, Any]:
    """The options of the head that `node` names, and the options of the heads that it extends.

    An option that the configuration lacks, as with `color.name=...` instead of `color=...`, has its default.
    """
    parameters = HEADS.options(node["name"]).items()
    defaults = {key: parameter.default for key, parameter in parameters if parameter.default is not parameter.empty}
    names = [HEADS.name_of(ancestor) for ancestor in reversed(chosen(node).__mro__)]
    return defaults | {key: value for name in names if name for key, value in node.get(name, {}).items()}
