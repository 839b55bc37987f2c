"""Which options act in a configuration. What `acting` returns is the configuration of a run.

It is what a run prints, stores, hashes to its id and compares with others. An option of a head that is not chosen is
not in it, nor is a group such as `qiren`, whose values the heads have copied, nor a degree of unused harmonics.

An option has a declared default, in a component's signature or in `config/settings.py`. The hash leaves out options at
their default. So a new option whose default does what was done before changes no id.

The hash also leaves out what is only recorded (`RECORDED`), such as where the scene lies or how often views are
evaluated. A run keeps these options, and another value of them is the same run.
"""

import dataclasses
import functools
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from inspect import Parameter
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from qnerf.auto.rules import AUTO, RULES
from qnerf.config import bounds
from qnerf.config.identity import clean, digest, plain
from qnerf.config.registry import Registry, options_of
from qnerf.config.settings import HEAD_GROUPS, Settings, SignalSettings, built
from qnerf.encoders import ENCODERS
from qnerf.geometry.contraction import CONTRACTIONS
from qnerf.geometry.pose_refinement import CAMERAS
from qnerf.heads import HEADS, chosen
from qnerf.model.labels import slug
from qnerf.quantum.circuit import ANSATZE
from qnerf.quantum.noise import Noise
from qnerf.rendering.samplers import SAMPLERS
from qnerf.rendering.shading import SHADINGS
from qnerf.scenes import SCENES
from qnerf.signals import is_signal

EXECUTION = (
    "device", "threads", "store", "run", "numerics.finite_checks", "train.checkpoint_every", "train.chunk",
)  # fmt: skip
"""Options and groups that say where and how a run is executed, not what it computes."""
RECORDED = ("scene.path", "train.name", "train.eval_every", "train.eval_views", "train.log_every")
"""Options that a run keeps but does not hash: the scene's place, the recipe's name, and what is measured how often."""
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
HEAD_SOURCES = ("initials", "rates", "activations")
"""Tables by head in the groups of heads, from which other options take their values."""
UNTRAINED = {
    "encoder": ("pe", "rff", "none", "signed"),
    "sampler": ("uniform", "disparity", "geometric", "piecewise", "vanilla"),
    "cameras": ("fixed",),
}
"""Group -> its components without parameters, which no learning rate acts on."""


@dataclass(frozen=True)
class Option:
    """One option that acts: its dotted name, value and annotation, and its declared default if it has one."""

    name: str
    value: Any
    hint: Any
    default: Any = Parameter.empty

    @property
    def is_empty(self) -> bool:
        """Whether the option is null, or an empty list, by default."""
        return self.value in (None, []) and _equal(self.value, self.default)

    @property
    def executes(self) -> bool:
        return f"{self.name}.".startswith(tuple(f"{key}." for key in EXECUTION))


def acting(config: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration of the run: the options of `config` that act, in groups, with declared defaults filled in.

    Options that are null by default, and are null, are left out.

    `acting` of its own result is the same.

    Raises:
        ValueError: an unknown or missing option, or a value that its annotation does not allow.
    """
    return _tree([option for option in options(config) if not (option.executes or option.is_empty)])


def complete(config: Mapping[str, Any]) -> dict[str, Any]:
    """`acting`, with the options that say where and how the run is executed."""
    return _tree(options(config))


def settings_of(config: Mapping[str, Any]) -> Settings | SignalSettings:
    """The checked settings of a configuration without `auto`; ValueError as `acting`."""
    return built(_kind(config), _tree(options(config)))


def column_types(config: Mapping[str, Any]) -> dict[str, str]:
    """Dotted option -> int, float, bool or text, by its annotation. Text also holds lists, as JSON."""
    return {option.name: _type(option.hint) for option in options(config) if not option.executes}


def decisive(config: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted options that decide the run's numbers and are not at their declared default: what an id hashes."""
    return {
        option.name: option.value
        for option in options(config)
        if not option.executes and option.name not in RECORDED and not _equal(option.value, option.default)
    }


def run_id(config: Mapping[str, Any], fingerprint: str) -> str:
    """A readable beginning and the hash of `decisive` with the scene's fingerprint."""
    return f"{clean(slug(acting(config)))}-{digest(decisive(config), fingerprint)}"


def changed(stored: Mapping[str, Any], today: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Dotted options whose values differ: name -> (stored, today). The scene's place may differ; None: does not act.

    Two configurations of the same id differ where a default has changed since, and in what a run records.
    """
    before, now = (
        {option.name: option.value for option in options(config) if not option.executes and option.name != "scene.path"}
        for config in (stored, today)
    )
    names = [name for name in dict.fromkeys([*before, *now]) if not _equal(before.get(name), now.get(name))]
    return {name: (before.get(name), now.get(name)) for name in names}


def without_effect(config: Mapping[str, Any], overrides: Sequence[str]) -> list[str]:
    """The overrides that the user typed and that change nothing in this configuration, such as color.degree=2 with
    color.directions=raw."""
    names = [option.name for option in options(config)]
    return [override for override in overrides if not _acts(config, names, override.lstrip("+~").partition("=")[0])]


def _acts(config: Mapping[str, Any], names: Sequence[str], key: str) -> bool:
    known = {one.name for one in dataclasses.fields(_kind(config))}
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
    return any(f"{name}.".startswith(f"{key}.") or f"{key}.".startswith(f"{name}.") for name in names)


def _extends(group: str, node: Mapping[str, Any], name: str) -> bool:
    """Whether the component that `node` names is the one called `name`, or extends it."""
    registry: Registry[Any] = HEADS if group in HEAD_GROUPS else COMPONENTS[group]
    return node["name"] == AUTO or registry.get(name) in getattr(registry.get(node["name"]), "__mro__", ())


def options(config: Mapping[str, Any]) -> list[Option]:
    """Every option that acts in the configuration, checked; ValueError as `acting`."""
    kind = _kind(config)
    known = {one.name for one in dataclasses.fields(Settings)} | {*HEAD_GROUPS, *SOURCES, "hydra"}
    if unknown := [key for key in config if key not in known]:
        raise ValueError(f"config: unknown option {unknown[0]}; known: {', '.join(sorted(known - {'hydra'}))}")
    found = [*_of_fields("", kind, config, others=known)]
    values = {option.name: option.value for option in found}
    idle = {name for names, unread in _IDLE for name in names if unread(values)}
    found = [option for option in found if option.name not in idle]
    for option in found:
        if not (option.name in RULES and option.value == AUTO):
            bounds.check(option.name, option.value, option.hint)
    return found


def _kind(config: Mapping[str, Any]) -> type[Settings] | type[SignalSettings]:
    """The settings of the configuration's kind of scene."""
    if "scene" not in config:
        raise ValueError("config: missing scene")
    signal = is_signal(_group("scene", config["scene"]))
    wanted = "head" if signal else "density and color"
    if signal != ("head" in config):
        name = config["scene"]["name"]
        raise ValueError(f"scene={name} needs the group {wanted}; choose it with scene={name}, not by scene.name")
    return SignalSettings if signal else Settings


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
    undecided = name == AUTO and f"{group}.name" in RULES
    parameters: dict[str, tuple[Parameter, Any]] = {}
    for candidate in registry.names() if undecided else [name]:
        parameters |= options_of(registry.get(candidate))
    given = {key: value for key, value in node.items() if key != "name"}
    if unknown := [key for key in given if key not in parameters]:
        known = ", ".join(parameters) or "none"
        raise ValueError(f"{group}={name}: unknown option {unknown[0]}={given[unknown[0]]!r}; known: {known}")
    for key, (parameter, hint) in parameters.items():
        if key in given or not undecided:
            yield _option(f"{group}.{key}", given, key, parameter, hint)


def _of_head(group: str, node: Mapping[str, Any]) -> Iterator[Option]:
    declared = {key: value for key, value in node.items() if key not in HEADS.names() and key not in HEAD_SOURCES}
    yield from _of_fields(f"{group}.", HEAD_GROUPS[group], declared, others=HEADS.names())
    head = chosen(node)
    owners = [name for name in map(HEADS.name_of, reversed(head.__mro__)) if name]
    given, places = {}, {}
    for owner in owners:
        for key, value in _group(f"{group}.{owner}", node.get(owner, {})).items():
            given[key], places[key] = value, owner
    parameters = options_of(HEADS.get(node["name"]))
    if unknown := [key for key in given if key not in parameters]:
        raise ValueError(
            f"{group}.{places[unknown[0]]}: unknown option {unknown[0]}={given[unknown[0]]!r}; "
            f"known: {', '.join(parameters)}"
        )
    values = {key: given.get(key, parameter.default) for key, (parameter, _) in parameters.items()}
    for key, (_, hint) in parameters.items():
        bounds.check(f"{group}.{places.get(key, owners[-1])}.{key}", values[key], hint)
    unread = head.unread(values)
    for key, (parameter, hint) in parameters.items():
        name = f"{group}.{places.get(key, owners[-1])}.{key}"
        if key in unread:
            continue
        if key == "noise":
            yield from _of_fields(f"{name}.", Noise, _group(name, values[key]))
        elif key == "ansatz_options":
            own = (values[key] or {}).get(values["ansatz"], {})
            ansatz = ANSATZE.get(values["ansatz"])
            ANSATZE.check(values["ansatz"], own)
            for inner, (described, inner_hint) in options_of(ansatz).items():
                yield _option(f"{name}.{values['ansatz']}.{inner}", own, inner, described, inner_hint)
        else:
            yield _option(name, given, key, parameter, hint)


def _option(name: str, given: Mapping[str, Any], key: str, parameter: Parameter, hint: Any) -> Option:
    if key not in given and parameter.default is Parameter.empty:
        raise ValueError(f"{name.rpartition('.')[0]}: missing {key}")
    return Option(name, plain(given.get(key, parameter.default), name), hint, plain_default(parameter.default))


def plain_default(default: Any) -> Any:
    return default if default is Parameter.empty else plain(default)


def _off(*names: str) -> Callable[[Mapping[str, Any]], bool]:
    """Whether none of these options is set."""
    return lambda values: not any(values.get(name) for name in names)


_IDLE: list[tuple[tuple[str, ...], Callable[[Mapping[str, Any]], bool]]] = [
    (("pose_noise.seed",), _off("pose_noise.rotation", "pose_noise.translation")),
    (("visibility.resolution",), _off("visibility.cameras", "visibility.alpha", "occupancy.every")),
    (("occupancy.after", "occupancy.min_opacity"), _off("occupancy.every")),
    (("stop.patience", "stop.min_gain_db", "stop.share", "stop.rays"), _off("stop.every")),
    (("train.eval_views",), _off("train.eval_every")),
    (("train.rates.appearance",), _off("appearance")),
    (("color.degree",), lambda values: values.get("color.directions") != "sh"),
    (("color.direction_scale",), lambda values: values.get("color.directions") != "raw"),
    (("train.rates.encoder",), lambda values: values.get("encoder.name") in UNTRAINED["encoder"]),
    (("train.rates.cameras",), lambda values: values.get("cameras.name") in UNTRAINED["cameras"]),
    (("train.rates.sampler", "train.interlevel"), lambda values: values.get("sampler.name") in UNTRAINED["sampler"]),
]
"""Options that do not act where a condition on other groups holds. Options of one head are `Head.unread`."""


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


def _equal(one: Any, other: Any) -> bool:
    """Equality of option values; true is not 1."""
    return bool(one == other) and isinstance(one, bool) == isinstance(other, bool)


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
