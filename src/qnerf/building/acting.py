"""Which options act in a configuration, each with its value, its annotation and its declared default.

An option of a head that is not chosen is not among them, nor is a group such as `qiren`, whose values the heads have
copied, nor a degree of unused harmonics.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from inspect import Parameter
from typing import Any, get_type_hints

from qnerf.auto.rules import AUTO, RULES
from qnerf.config import bounds
from qnerf.config.identity import plain
from qnerf.config.registry import Registry, options_of
from qnerf.config.settings import HEAD_GROUPS, Common, Settings, Validation
from qnerf.encoders import ENCODERS
from qnerf.geometry.contraction import CONTRACTIONS
from qnerf.geometry.pose_refinement import CAMERAS
from qnerf.heads import HEADS, chosen
from qnerf.heads.mlp import MLPHead
from qnerf.quantum.circuit import ANSATZE
from qnerf.quantum.noise import Noise
from qnerf.rendering.samplers import SAMPLERS
from qnerf.rendering.shading import SHADINGS
from qnerf.signals import SCENES
from qnerf.training.task import Task

COMPONENTS: dict[str, Registry[Any]] = {
    "contraction": CONTRACTIONS,
    "encoder": ENCODERS,
    "scene": SCENES,
    "sampler": SAMPLERS,
    "shading": SHADINGS,
    "cameras": CAMERAS,
}
"""Group -> the registry of the component that its key `name` chooses."""
SOURCES: dict[str, tuple[tuple[str, ...], str]] = {
    "hash": (("encoder",), "hash"),
    "proposal": (("sampler",), "proposal"),
    "qiren": (tuple(HEAD_GROUPS), "qiren"),
    "qfgn": (tuple(HEAD_GROUPS), "qfgn"),
}
"""Group of defaults -> the groups that copy its values, and the name of the component whose options they are."""
EVERY_SCENE = ("validation",)
"""Options of the group `scene` whatever scene it names."""
HEAD_SOURCES = ("initials", "rates", "activations", "space")
"""Tables in the groups of heads: by head, from which other options take their values; and what a search may vary."""


@dataclass(frozen=True)
class Option:
    """One option that acts: its dotted name, value and annotation, and its declared default if it has one.

    ValueError where the annotation does not allow the value; `auto` is allowed where a rule decides.
    """

    name: str
    value: Any
    hint: Any
    default: Any = Parameter.empty

    def __post_init__(self) -> None:
        if not (self.value == AUTO and self.name in RULES):
            bounds.check(self.name, self.value, self.hint)

    @property
    def is_default(self) -> bool:
        return equal(self.value, self.default)


def acts(config: Mapping[str, Any], found: Sequence[Option], key: str) -> bool:
    """Whether an option, a group or a choice that the user typed changes anything. found: the options that act."""
    known = {one.name for one in dataclasses.fields(kind_of(config))}
    key = key.removeprefix("head@")
    if key == "field":
        return "head" not in known
    group, _, option = key.partition(".")
    group = "qiren" if group == "ansatz" else group
    if group in SOURCES:
        users, name = SOURCES[group]
        return any(_extends(user, config[user], name) for user in users if user in known and user in config)
    if not option:
        return group in known or group not in {*HEAD_GROUPS, *(one.name for one in dataclasses.fields(Settings))}
    if group in HEAD_GROUPS and option.partition(".")[0] in HEAD_SOURCES:
        return group in config
    names = [one.name for one in found]
    return any(f"{name}.".startswith(f"{key}.") or f"{key}.".startswith(f"{name}.") for name in names)


def _extends(group: str, node: Mapping[str, Any], name: str) -> bool:
    """Whether the component that `node` names is the one called `name`, or extends it."""
    registry: Registry[Any] = HEADS if group in HEAD_GROUPS else COMPONENTS[group]
    return node["name"] == AUTO or registry.get(name) in getattr(registry.get(node["name"]), "__mro__", ())


def options(config: Mapping[str, Any]) -> list[Option]:
    """Every option that acts in the configuration, checked.

    Raises:
        ValueError: an unknown or missing option, or a value that its annotation does not allow.
    """
    kind = kind_of(config)
    known = {one.name for of in (Settings, kind) for one in dataclasses.fields(of)} | {*HEAD_GROUPS, *SOURCES, "hydra"}
    if unknown := [key for key in config if key not in known]:
        raise ValueError(f"config: unknown option {unknown[0]}; known: {', '.join(sorted(known - {'hydra'}))}")
    found = [*_of_fields("", kind, config, others=known)]
    values = {option.name: option.value for option in found}
    left_out = {name for names, condition in _WITHOUT_EFFECT for name in names if condition(values)}
    return [option for option in found if option.name not in left_out]


def kind_of(config: Mapping[str, Any]) -> type[Common]:
    """The dataclass of the options that a configuration of this kind of scene has."""
    if "scene" not in config:
        raise ValueError("config: missing scene")
    kind = options_of_scene(_group("scene", config["scene"])["name"])
    heads = HEAD_GROUPS.keys() & {one.name for one in dataclasses.fields(kind)}
    if not heads <= config.keys() or ("head" in config) != ("head" in heads):
        name, wanted = config["scene"]["name"], " and ".join(group for group in HEAD_GROUPS if group in heads)
        raise ValueError(f"scene={name} needs the group {wanted}; choose it with scene={name}, not by scene.name")
    return kind


def options_of_scene(name: str) -> type[Common]:
    """The dataclass of the options of a scene's task; ValueError for an unknown name."""
    scene = SCENES.get(name)
    return scene.options if isinstance(scene, type) and issubclass(scene, Task) else Settings


def _of_fields(
    prefix: str, kind: type, node: Mapping[str, Any], others: Sequence[str] | set[str] = ()
) -> Iterator[Option]:
    """The options that a dataclass declares. others: further keys that the node may have."""
    declared = {one.name: one for one in dataclasses.fields(kind)}
    label = prefix.rstrip(".") or "config"
    if unknown := [key for key in node if key not in declared and key not in others]:
        raise ValueError(f"{label}: unknown option {unknown[0]}={node[unknown[0]]!r}; known: {', '.join(declared)}")
    for key, hint in _hints(kind).items():
        if key not in declared:
            continue
        name = f"{prefix}{key}"
        if name in HEAD_GROUPS or name in COMPONENTS:
            if key not in node:
                raise ValueError(f"{label}: missing {key}")
            yield from (_of_head if name in HEAD_GROUPS else _of_component)(name, _group(name, node[key]))
        elif isinstance(hint, type) and dataclasses.is_dataclass(hint):
            yield from _of_fields(f"{name}.", hint, _group(name, node.get(key, {})))
        else:
            default = _default(declared[key])
            if key not in node and default is Parameter.empty:
                raise ValueError(f"{label}: missing {key}")
            yield Option(name, plain(node.get(key, default), name), hint, default)


def _of_component(group: str, node: Mapping[str, Any]) -> Iterator[Option]:
    registry = COMPONENTS[group]
    name = node.get("name")
    if name is None:
        raise ValueError(f"{group}: missing name")
    yield Option(f"{group}.name", name, str)
    given = {key: value for key, value in node.items() if key not in ("name", *EVERY_SCENE * (group == "scene"))}
    if name == AUTO and f"{group}.name" in RULES:
        parameters: dict[str, tuple[Parameter, Any]] = {}
        for candidate in registry.names():
            parameters |= options_of(registry.get(candidate))
        _check_names(f"{group}={name}", given, parameters)
        parameters = {key: parameter for key, parameter in parameters.items() if key in given}
    else:
        parameters = options_of(registry.get(name))
        _check_names(f"{group}={name}", given, parameters)
    for key, parameter in parameters.items():
        yield _option(f"{group}.{key}", given, key, *parameter)
    if group == "scene":
        yield Option("scene.validation", node.get("validation"), Validation, None)


def _of_head(group: str, node: Mapping[str, Any]) -> Iterator[Option]:
    declared = {key: value for key, value in node.items() if key not in HEADS.names() and key not in HEAD_SOURCES}
    yield from _of_fields(f"{group}.", HEAD_GROUPS[group], declared, others=HEADS.names())
    head = chosen(node)
    parameters = options_of(HEADS.get(node["name"]))
    owners = [name for name in map(HEADS.name_of, reversed(head.__mro__)) if name]
    given: dict[str, Any] = {}
    places = dict.fromkeys(parameters, owners[-1])
    for owner in owners:
        own = _group(f"{group}.{owner}", node.get(owner, {}))
        _check_names(f"{group}.{owner}", own, parameters)
        given |= own
        places |= dict.fromkeys(own, owner)
    found = {key: _option(f"{group}.{places[key]}.{key}", given, key, *parameters[key]) for key in parameters}
    left_out = head.without_effect({key: option.value for key, option in found.items()})
    for key, option in found.items():
        if key in left_out:
            continue
        if key == "noise":
            yield from _of_fields(f"{option.name}.", Noise, option.value)
        elif key == "ansatz_options":
            yield from _of_ansatz(option, found["ansatz"].value)
        else:
            yield option


def _of_ansatz(given: Option, name: str) -> Iterator[Option]:
    """The options of the ansatz `name`, out of those that are given for every ansatz."""
    parameters, own = options_of(ANSATZE.get(name)), (given.value or {}).get(name, {})
    _check_names(f"ansatz={name}", own, parameters)
    for key, parameter in parameters.items():
        yield _option(f"{given.name}.{name}.{key}", own, key, *parameter)


def _check_names(where: str, given: Mapping[str, Any], known: Iterable[str]) -> None:
    """ValueError where an option is given that the component does not have."""
    if unknown := [key for key in given if key not in known]:
        listed = ", ".join(known) or "none"
        raise ValueError(f"{where}: unknown option {unknown[0]}={given[unknown[0]]!r}; known: {listed}")


def _option(name: str, given: Mapping[str, Any], key: str, parameter: Parameter, hint: Any) -> Option:
    default = parameter.default
    if key not in given and default is Parameter.empty:
        raise ValueError(f"{name.rpartition('.')[0]}: missing {key}")
    declared = default if default is Parameter.empty else plain(default)
    return Option(name, plain(given.get(key, default), name), hint, declared)


def _off(*names: str) -> Callable[[Mapping[str, Any]], bool]:
    """Whether none of these options is set."""
    return lambda values: not any(values.get(name) for name in names)


def _untrainable(group: str) -> Callable[[Mapping[str, Any]], bool]:
    """Whether the component of the group has no parameters, so that no learning rate acts on it."""

    def condition(values: Mapping[str, Any]) -> bool:
        name = values.get(f"{group}.name")
        return name is not None and name != AUTO and not getattr(COMPONENTS[group].get(name), "trainable", True)

    return condition


def _has_mlp(values: Mapping[str, Any]) -> bool:
    heads = [HEADS.get(values[f"{group}.name"]) for group in HEAD_GROUPS if f"{group}.name" in values]
    return any(isinstance(head, type) and issubclass(head, MLPHead) for head in heads)


_WITHOUT_EFFECT: list[tuple[tuple[str, ...], Callable[[Mapping[str, Any]], bool]]] = [
    (("numerics.precision",), lambda values: values.get("numerics.dtype") != "float32" or not _has_mlp(values)),
    (("pose_noise.seed",), _off("pose_noise.rotation", "pose_noise.translation")),
    (("visibility.resolution",), _off("visibility.cameras", "visibility.alpha")),
    (("stop.patience", "stop.min_gain_db", "stop.share", "stop.rays"), _off("stop.every")),
    (("train.eval_views",), _off("train.eval_every")),
    (("train.rates.appearance",), _off("appearance")),
    (("color.degree",), lambda values: values.get("color.directions") != "sh"),
    (("color.direction_scale",), lambda values: values.get("color.directions") != "raw"),
    (("train.rates.encoder",), _untrainable("encoder")),
    (("train.rates.cameras",), _untrainable("cameras")),
    (("train.rates.sampler", "train.interlevel"), _untrainable("sampler")),
]
"""Options that do not act where a condition on other groups holds. Options of one head are `Head.without_effect`."""


def _group(name: str, node: Any) -> Mapping[str, Any]:
    if not isinstance(node, Mapping):
        raise ValueError(f"{name} must be a group of options, got {node!r}")
    return node


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def _default(one: "dataclasses.Field[Any]") -> Any:
    if one.default is not dataclasses.MISSING:
        return one.default
    return Parameter.empty if one.default_factory is dataclasses.MISSING else one.default_factory()


def equal(one: Any, other: Any) -> bool:
    """Equality of option values; true is not 1."""
    return bool(one == other) and isinstance(one, bool) == isinstance(other, bool)
