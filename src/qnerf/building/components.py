"""Components by the name that the configuration gives: built, and their options checked."""

from collections.abc import Callable, Collection, Mapping
from typing import Any

from qnerf import auto
from qnerf.config.registry import Registry, check_options, options_of
from qnerf.config.settings import (
    declared,
    require,
)
from qnerf.encoders import ENCODERS
from qnerf.geometry.contraction import CONTRACTIONS
from qnerf.geometry.pose_refinement import CAMERAS
from qnerf.heads import HEADS
from qnerf.model.labels import LABELLED
from qnerf.rendering.samplers import SAMPLERS
from qnerf.rendering.shading import SHADINGS
from qnerf.scenes import SCENES
from qnerf.signals import is_signal


def component(registry: Any, node: Mapping[str, Any], *wiring: Any) -> Any:
    """Builds the component `node["name"]` with the node's other keys as options."""
    options = {key: value for key, value in node.items() if key != "name"}
    return registry.build(node["name"], *wiring, **options)


REGISTRIES: dict[str, Registry[Any]] = {
    "contraction": CONTRACTIONS,
    "encoder": ENCODERS,
    "scene": SCENES,
    "sampler": SAMPLERS,
    "shading": SHADINGS,
    "cameras": CAMERAS,
}
"""Group -> the registry of the component that its key `name` chooses."""
SHARED: dict[str, tuple[Registry[Any], str]] = {
    "hash": (ENCODERS, "hash"),
    "proposal": (SAMPLERS, "proposal"),
    "qiren": (HEADS, "qiren"),
    "qfgn": (HEADS, "qfgn"),
}
"""Group of defaults -> the component whose options they are."""


def check_components(config: Mapping[str, Any], undecided: Collection[str] = ()) -> None:
    """ValueError unless the options of all components fit their declarations, those of unused heads and tables too.

    undecided: as in `check_settings`, which has checked the config before. While there are any, every option may be
    `auto`: it may be the copy of an undecided one.
    """
    tables = [option for option in undecided if option.startswith("hash.")]
    undecided = {*undecided, *(option.replace("hash.", "encoder.") for option in tables)}  # the encoder follows them

    def check(group: str, node: Any, *components: Callable[..., Any]) -> None:
        """Each option of the node, which is one of any of the components."""
        require(group, node, ())
        for key, value in node.items():
            if key != "name" and not (undecided and value == auto.AUTO):
                owner = next((one for one in components if key in options_of(one)), components[0])
                check_options(f"{group}.", owner, {key: value})

    if is_signal(config["scene"]) != ("head" in config):
        heads = "density and color" if "head" in config else "head"
        name = config["scene"]["name"]
        raise ValueError(f"scene={name} needs the group {heads}; choose it with scene={name}, not by scene.name")
    for group, registry in REGISTRIES.items():
        if group not in config:
            continue
        names = registry.names() if f"{group}.name" in undecided else [config[group]["name"]]
        check(group, config[group], *map(registry.get, names))
    for group, (registry, name) in SHARED.items():
        if group not in config:
            continue
        require(group, config[group], LABELLED.get(group, ()))
        check(group, config[group], registry.get(name))
    for group in filter(config.__contains__, ("density", "color", "head")):
        node = config[group]
        HEADS.get(node["name"])
        for key in [key for key in node if key not in declared(group)]:
            if key not in HEADS.names():
                known = ", ".join([*declared(group), *HEADS.names()])
                raise ValueError(f"{group}: unknown option {key}={node[key]!r}; known: {known}")
            check(f"{group}.{key}", node[key], HEADS.get(key))
