"""A configuration, worked out once: what acts, the settings, the types of the columns, the id.

What acts (`building/acting.py`) is the configuration of a run. A run prints, stores and compares it, and its id hashes
it.

The hash leaves out options at their declared default, in a component's signature or in `config/settings.py`. So a new
option whose default keeps today's behaviour changes no id. It also leaves out what is only recorded (`RECORDED`), such
as the scene's place or how often views are evaluated: another value of these is the same run.
"""

import types
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, Union, get_args, get_origin

from qnerf.building.acting import Option, acts, equal, kind_of, options
from qnerf.config.identity import clean, digest
from qnerf.config.settings import Common, built
from qnerf.model.labels import slug
from qnerf.records.schemas import RECORDED

EXECUTION = ("device", "threads", "store", "run", "train.checkpoint_every", "train.chunk")
"""Options and groups that say where and how a run is executed, not what it computes."""


@dataclass(frozen=True)
class Configuration:
    """Checked options. `given`: the resolved tree that they were found in."""

    given: Mapping[str, Any]
    options: tuple[Option, ...]

    @classmethod
    def of(cls, config: "Mapping[str, Any] | Configuration") -> "Configuration":
        """Checks every option. A configuration that is worked out already stays as it is.

        Raises:
            ValueError: an unknown or missing option, or a value that its annotation does not allow.
        """
        if isinstance(config, Configuration):
            return config
        return cls(config, tuple(options(config)))

    def with_values(self, values: Mapping[str, Any]) -> "Configuration":
        """The configuration with other values of dotted options that act, except names of components.

        ValueError as `of`.
        """
        if unknown := values.keys() - {option.name for option in self.options}:
            raise ValueError(f"{min(unknown)}={values[min(unknown)]}: no such option acts in this configuration")
        changed = [replace(one, value=values.get(one.name, one.value)) for one in self.options]
        return Configuration(self.given, tuple(changed))

    def __getitem__(self, name: str) -> Any:
        """The value of a dotted option that acts; KeyError where it does not."""
        return {option.name: option.value for option in self.options}[name]

    @cached_property
    def complete(self) -> dict[str, Any]:
        """All options, in groups, with declared defaults filled in."""
        return _tree(self.options)

    @cached_property
    def acting(self) -> dict[str, Any]:
        """The configuration of the run: `complete` without what says how it is executed, and without options that are
        null, or an empty list, by default."""
        return _tree([one for one in self._computing if one.value not in (None, []) or not one.is_default])

    @cached_property
    def settings(self) -> Common:
        """ValueError where options contradict each other."""
        return built(kind_of(self.given), self.complete)

    @property
    def types(self) -> dict[str, str]:
        """Dotted option -> int, float, bool or text, by its annotation. Text also holds lists, as JSON."""
        return {option.name: _type(option.hint) for option in self._computing}

    @property
    def decisive(self) -> dict[str, Any]:
        """Dotted options that decide the run's numbers and are not at their declared default: what an id hashes."""
        return {
            option.name: option.value
            for option in self._computing
            if option.name not in RECORDED and not option.is_default
        }

    def run_id(self, fingerprint: str) -> str:
        """A readable beginning and the hash of `decisive` with the scene's fingerprint."""
        return f"{clean(slug(self.acting))}-{digest(self.decisive, fingerprint)}"

    def differences(self, stored: "Configuration") -> dict[str, tuple[Any, Any]]:
        """Dotted options whose values differ from those of a stored run: name -> (stored, today); None: does not act.

        The scene's place may differ. Two configurations of the same id differ where a default has changed since, and in
        what a run records.
        """
        before, now = (
            {option.name: option.value for option in one._computing if option.name != "scene.path"}
            for one in (stored, self)
        )
        names = [name for name in dict.fromkeys([*before, *now]) if not equal(before.get(name), now.get(name))]
        return {name: (before.get(name), now.get(name)) for name in names}

    def without_effect(self, overrides: Sequence[str]) -> list[str]:
        """The overrides that the user typed and that change nothing in this configuration, such as color.degree=2 with
        color.directions=raw."""
        keys = {override: override.lstrip("+~").partition("=")[0] for override in overrides}
        return [override for override in overrides if not acts(self.given, self.options, keys[override])]

    @property
    def _computing(self) -> list[Option]:
        execution = tuple(f"{key}." for key in EXECUTION)
        return [option for option in self.options if not f"{option.name}.".startswith(execution)]


def _type(hint: Any) -> str:
    if get_origin(hint) is Annotated:
        return _type(get_args(hint)[0])
    if get_origin(hint) in (Union, types.UnionType):
        kinds = {_type(part) for part in get_args(hint) if part is not types.NoneType}
        return kinds.pop() if len(kinds) == 1 else "text"
    return {bool: "bool", int: "int", float: "float"}.get(hint, "text")


def _tree(found: Sequence[Option]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for option in found:
        *groups, last = option.name.split(".")
        node = tree
        for group in groups:
            node = node.setdefault(group, {})
        node[last] = option.value
    return tree
