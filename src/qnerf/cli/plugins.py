"""`plugins=[my_module]`: makes the user's components choices of the config groups, without any YAML."""

import os
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from qnerf.config.plugins import import_plugins
from qnerf.config.registry import Registry


def groups() -> Mapping[str, Registry[Any]]:
    """Config group -> the registry of its components."""
    from qnerf.building.acting import COMPONENTS
    from qnerf.heads import HEADS
    from qnerf.quantum.circuit import ANSATZE

    return {**COMPONENTS, "head": HEADS, "ansatz": ANSATZE}


def load(names: Sequence[str]) -> None:
    """Imports the modules, from the current folder too, and makes each component without a YAML a choice of its group.

    Raises:
        ValueError: a module that cannot be found.
    """
    if not names:
        return
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    import_plugins(names)

    from hydra.core.config_store import ConfigStore

    for group, registry in groups().items():
        for name in registry.names():
            if not is_choice(group, name):
                ConfigStore.instance().store(
                    name=name, node=node(group, name), group=group, package=_package(group, name)
                )


def is_choice(group: str, name: object) -> bool:
    """Whether the user can choose `group=name`: the package has a YAML for it, or `load` added it."""
    from hydra.core.config_store import ConfigStore

    from qnerf.config.folders import CONF

    return (CONF / group / f"{name}.yaml").is_file() or f"{name}.yaml" in ConfigStore.instance().repo.get(group, {})


def _package(group: str, name: str) -> str | None:
    """Where the configuration has the component's options, if not under the group's name."""
    if group == "ansatz":
        return "qiren"
    return "_global_" if group == "scene" and _base(name) else None


def _base(scene: str) -> str:
    """The file of conf/scene that the YAML of such a scene begins with; empty for posed images."""
    from qnerf.signals import SCENES

    return getattr(SCENES.get(scene), "base", "")


def node(group: str, name: str) -> dict[str, Any]:
    """What conf/<group>/<name>.yaml would contain, from the component's signature; ??? stands for a missing default."""
    registry = groups()[group]
    options = {
        option: "???" if parameter.default is parameter.empty else _plain(parameter.default)
        for option, parameter in registry.options(name).items()
    }
    if group == "ansatz":
        return {"ansatz": name, "ansatz_options": {name: options} if options else {}}
    if group == "scene" and (base := _base(name)):
        return {"defaults": [base, "_self_"], "scene": {"name": name, **options}}
    if group != "head":
        return {"name": name, **options}
    for ancestor in getattr(registry.get(name), "__mro__", ())[1:]:
        inherited = registry.name_of(ancestor)
        for option in registry.options(inherited) if inherited else ():
            options.pop(option, None)
    return {"defaults": ["_base"], "name": name, **({name: options} if options else {})}


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, (tuple, set)) else value
