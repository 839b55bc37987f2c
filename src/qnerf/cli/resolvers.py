"""`${of_head:...}` in conf/: defaults that depend on the chosen head. Import this module before composing."""

from typing import Any

from omegaconf import DictConfig, OmegaConf


def of_head(group: str, name: str, default: Any, *, _root_: DictConfig) -> Any:
    """The entry of `group`, such as density.rates, for the head `name`.

    A head without an entry takes that of the head whose recipe it follows (`Head.recipe`); without that, `default`.
    """
    from qnerf.heads import HEADS

    values = OmegaConf.select(_root_, group)
    names = [name, HEADS.get(name).recipe] if name in HEADS.names() else [name]  # type: ignore[attr-defined]
    return next((values[key] for key in names if key in values), default)


OmegaConf.register_new_resolver("of_head", of_head, replace=True)
