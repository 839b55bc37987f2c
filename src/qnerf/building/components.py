"""Builds the component that a group of the configuration names."""

from collections.abc import Mapping
from typing import Any


def component(registry: Any, node: Mapping[str, Any], *wiring: Any) -> Any:
    """Builds the component `node["name"]` with the node's other keys as options."""
    options = {key: value for key, value in node.items() if key != "name"}
    return registry.build(node["name"], *wiring, **options)
