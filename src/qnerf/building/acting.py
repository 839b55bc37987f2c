"""Which settings of a configuration have an effect."""

from collections.abc import Mapping, Sequence
from typing import Any

from qnerf.building.components import REGISTRIES, SHARED
from qnerf.config.registry import Registry
from qnerf.heads import HEADS, head_options

_HEADS = ("density", "color", "head")
_OF_HEADS = ("initials", "rates", "activations")  # head -> value
_NO_RESULT = ("run", "store", "device", "threads", "experiment")


def what_acts(config: Mapping[str, Any]) -> dict[str, Any]:
    """The resolved configuration without what changes no result, such as options of heads that it does not use.

    Two configurations with the same result may still differ in it: it does not know every option's meaning.
    """
    kept = {key: value for key, value in config.items() if key not in (*SHARED, *_NO_RESULT)}
    return kept | {head: _of_head(kept[head]) for head in _HEADS if head in kept}


def idle(config: Mapping[str, Any], overrides: Sequence[str]) -> list[str]:
    """The overrides whose option no chosen component reads, such as color.degree=2 with color.directions=raw.

    config: has passed `check_components`. Options of a group that every configuration reads are never idle.
    """
    return [override for override in overrides if not _acts(config, override.lstrip("+~").partition("=")[0])]


def _acts(config: Mapping[str, Any], key: str) -> bool:
    group, _, option = key.partition(".")
    group = "qiren" if group == "ansatz" else group
    if group in SHARED:
        registry, name = SHARED[group]
        users = _HEADS if registry is HEADS else [user for user, known in REGISTRIES.items() if known is registry]
        return any(_extends(registry, config[user], name) for user in users if user in config)
    if not option or group not in _HEADS:
        return True
    option = option.partition(".")[0]
    if option in HEADS.names():
        return _extends(HEADS, config[group], option)
    return option in _of_head(config[group])


def _extends(registry: Registry[Any], node: Mapping[str, Any], name: str) -> bool:
    """Whether the component that `node` names is the one called `name`, or extends it."""
    return registry.get(name) in getattr(registry.get(node["name"]), "__mro__", ())


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
