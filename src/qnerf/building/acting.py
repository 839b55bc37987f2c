"""Which settings of a configuration have an effect."""

from collections.abc import Mapping
from typing import Any

from qnerf.building.components import SHARED
from qnerf.heads import head_options

_HEADS = ("density", "color", "head")
_OF_HEADS = ("initials", "rates", "activations")  # head -> value
_NO_RESULT = ("run", "store", "device", "threads", "experiment")


def what_acts(config: Mapping[str, Any]) -> dict[str, Any]:
    """The resolved configuration without what changes no result, such as options of heads that it does not use.

    Two configurations with the same result may still differ in it: it does not know every option's meaning.
    """
    kept = {key: value for key, value in config.items() if key not in (*SHARED, *_NO_RESULT)}
    return kept | {head: _of_head(kept[head]) for head in _HEADS if head in kept}


def _of_head(node: Mapping[str, Any]) -> dict[str, Any]:
    name = node["name"]
    plain = {key: value for key, value in node.items() if not isinstance(value, Mapping)}
    if "directions" in plain:
        unread = {"sh": "direction_scale", "raw": "degree"}
        plain.pop(unread.get(plain["directions"], ""), None)
    options = head_options(node)
    if "ansatz_options" in options:
        options["ansatz_options"] = options["ansatz_options"].get(options["ansatz"])
    return plain | {key: node[key].get(name) for key in _OF_HEADS if key in node} | {"options": options}
