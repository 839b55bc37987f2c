"""`${of_head:...}` in conf/: defaults that depend on the chosen head. Import this module before composing."""

import inspect
from typing import Any

import hydra
from omegaconf import DictConfig, OmegaConf

HYDRA: dict[str, Any] = {"version_base": "1.3"} if hydra.__version__.startswith("1.3") else {}
"""What Hydra's entry points are given: Hydra 1.3 asks for the behaviour of a version, later ones have one behaviour."""

MAIN: dict[str, Any] = HYDRA or {"execution_whitelist": ["qnerf.*", "hydra.*", "hydra_plugins.*"]}
"""What `hydra.main` is given: later versions ask which classes a configuration may name."""


def of_head(group: str, name: str, default: Any, *, _root_: DictConfig) -> Any:
    """The entry of `group`, such as density.rates, for the head `name`.

    A head without an entry takes that of the head whose recipe it follows (`Head.recipe`); without that, `default`.
    ValueError of an unknown head: its module may not be imported yet, and its recipe would be ignored.
    """
    from qnerf.heads import HEADS

    values = OmegaConf.select(_root_, group)
    names = [name, HEADS.get(name).recipe]  # type: ignore[attr-defined]
    return next((values[key] for key in names if key in values), default)


# OmegaConf 2.4.1 gives the name of an older function, without `replace`, to what was register_new_resolver.
_renamed = "replace" in inspect.signature(OmegaConf.register_resolver).parameters
_register: Any = OmegaConf.register_resolver if _renamed else OmegaConf.register_new_resolver
_register("of_head", of_head, replace=True)
