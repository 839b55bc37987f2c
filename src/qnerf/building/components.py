"""Builds the component that a group of the configuration names."""

from collections.abc import Mapping
from typing import Any

from torch import nn


def component(registry: Any, node: Mapping[str, Any], *wiring: Any) -> Any:
    """Builds the component `node["name"]` with the node's other keys as options, which have been checked.

    ValueError where a class that says it has no parameters (`trainable = False`) has some.
    """
    options = {key: value for key, value in node.items() if key != "name"}
    built = registry.build_checked(node["name"], *wiring, **options)
    if isinstance(built, nn.Module) and not getattr(built, "trainable", True) and list(built.parameters()):
        raise ValueError(f"{registry.group}={node['name']}: has parameters; expected `trainable = True` in its class")
    return built
