"""What the user typed, before Hydra reads it: short forms, plugins, and advice where Hydra's messages have none."""

import contextlib
import re
import threading
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from functools import lru_cache
from pathlib import Path
from typing import Any, NoReturn

from hydra import version
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.utils import create_config_search_path
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException, MissingConfigException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException
from packaging.version import Version
from yaml import YAMLError  # type: ignore[import-untyped]

from qnerf.cli import plugins as plugin_modules
from qnerf.cli.errors import one_line
from qnerf.cli.resolvers import HYDRA
from qnerf.config.folders import CONF, SWEEPS
from qnerf.config.identity import leaves

HEADS = ("density", "color")
SHOWN = 3  # suggestions
_turn = threading.Lock()  # one composes at a time: a part of Hydra's state is global
_OVERRIDE = re.compile(r"(?P<sign>~|\+\+|\+)?(?P<key>[A-Za-z_][\w./@-]*)(?P<value>=.*)?", re.DOTALL)


def expand_sweep(arguments: Sequence[str]) -> list[str]:
    """Replaces `--sweep NAME` by the options with which Hydra finds the sweep's file.

    NAME is a sweep that comes with qnerf, or the path of a YAML file.

    Raises:
        ValueError: no such sweep, or no NAME.

    >>> expand_sweep(["--sweep", "seeds", "budget=short"])
    ['-cd', '.../sweeps', '-cn', 'seeds', 'budget=short']
    """
    expanded = []
    rest = iter(arguments)
    for argument in rest:
        option, equals, name = argument.partition("=")
        if option != "--sweep":
            expanded.append(argument)
            continue
        name = name if equals else next(rest, "")
        file = Path(name) if name.endswith(".yaml") else SWEEPS / f"{name}.yaml"
        if not file.is_file():
            known = sorted(sweep.stem for sweep in SWEEPS.glob("*.yaml"))
            raise ValueError(f"--sweep expects a .yaml file or a known sweep, got {name!r}{_suggested(name, known)}")
        _check_sweep(file)
        expanded += ["-cd", str(file.parent.absolute()), "-cn", file.stem]
    return expanded


def _check_sweep(file: Path) -> None:
    """ValueError unless the file adds to the configuration, as the sweeps that come with qnerf do."""
    try:
        content = OmegaConf.load(file)
    except (YAMLError, OSError, ValueError) as error:
        raise ValueError(f"--sweep {file}: cannot be read: {one_line(error)}") from None
    if not isinstance(content, DictConfig) or "config" not in (content.get("defaults") or []):
        raise ValueError(f"--sweep {file}: expected `defaults: [config, _self_]` first, as in {SWEEPS / 'seeds.yaml'}")


def arguments_for_hydra(arguments: Sequence[str]) -> tuple[list[str], dict[str, Any]]:
    """Hydra's own options before the overrides, because Hydra wants them so, and the values of those options.

    >>> arguments_for_hydra(["seed=0", "-m", "density=qiren"])[0]
    ['-m', 'seed=0', 'head@density=qiren']
    """
    from hydra._internal.utils import get_args_parser

    parser = get_args_parser()
    parser.error = _refuse  # type: ignore[method-assign]
    parsed = vars(parser.parse_intermixed_args(list(arguments)))
    rest = list(arguments)
    for override in parsed["overrides"]:
        rest.remove(override)
    overrides = [translated(argument) for argument in parsed["overrides"]]
    for override in overrides:
        parse(override)
    return [*rest, *overrides], parsed


def translated(argument: str) -> str:
    """`density=qiren` and `color=qiren` as Hydra knows them.

    >>> translated("density=qiren"), translated("seed=1")
    ('head@density=qiren', 'seed=1')
    """
    key, _, value = argument.partition("=")
    name = key.lstrip("+~")
    return argument.replace(name, f"head@{name}", 1) if name in HEADS and not value.startswith("{") else argument


def parse(argument: str) -> Override:
    """One override, as Hydra reads it; ValueError with the cure if Hydra cannot."""
    match = _OVERRIDE.fullmatch(argument)
    if match is None or not (match["value"] or match["sign"] == "~"):
        name = re.split("[ =]", argument)[0]
        raise ValueError(f"{argument!r:.200}: expected OPTION=VALUE{hint(name) if name else ''}")
    try:
        return OverridesParser.create(config_loader=_loader()).parse_overrides([argument])[0]
    except (HydraException, RecursionError):
        raise ValueError(f"{argument:.200}: cannot be read; {_cure(argument)}") from None


def _cure(argument: str) -> str:
    """What to type instead of an override that Hydra cannot read."""
    key, _, value = argument.partition("=")
    if value.endswith(","):
        return f"several values have commas between them and no spaces, such as {key}=1,2,3"
    return f"close its brackets, or quote special characters for the shell and for Hydra: '{key}=\"{value[:80]}\"'"


def _refuse(message: str) -> NoReturn:
    unknown = re.match(r"unrecognized arguments: (--?)(\S+)", message)
    raise ValueError(f"{message}; an option is set by OPTION=VALUE{hint(unknown[2])}" if unknown else message)


def plugins(overrides: Iterable[str]) -> list[str]:
    """The modules of `plugins=[a,b]`, if any. ValueError if it is not a list of names."""
    names: list[str] = []
    for override in overrides:
        if override.lstrip("+").startswith("plugins="):
            value = parse(override).value()
            if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
                raise ValueError(f"{override[:80]}: expected a list of modules, such as plugins=[my_module]")
            names = value
    return names


def configuration(overrides: Sequence[str]) -> dict[str, Any]:
    """The resolved configuration that these overrides give on the command line; imports the plugins that it names.

    Raises:
        ValueError: a choice or an option that does not exist, an option without a value.
    """
    own = [translated(override) for override in overrides]
    for override in own:
        if override.lstrip("+~").startswith("hydra"):
            raise ValueError(f"{override}: options of Hydra are for the command line, qnerf run")
        parse(override)
    plugin_modules.load(plugins(own))
    try:
        resolved: Any = OmegaConf.to_container(_compose(own), resolve=True, throw_on_missing=True)
    except HydraException as error:
        raise ValueError(message(error, own)) from error
    except OmegaConfBaseException as error:
        raise ValueError(one_line(error)) from error
    return resolved


def _compose(overrides: Sequence[str], hydra: bool = False) -> DictConfig:
    """What Hydra composes. Its global state may be that of a program that calls this package, and is left alone.

    hydra: with Hydra's own options.
    """
    with _turn:
        base = version.VersionBase.instance()
        callers, base.version_base = base.version_base, Version(HYDRA.get("version_base", "1.3"))
        try:
            composed = _loader().load_configuration("config", list(overrides), RunMode.RUN, from_shell=False)
        finally:
            base.version_base = callers
    if not hydra:
        with open_dict(composed):
            del composed["hydra"]
    return composed


@lru_cache(maxsize=1)
def _loader() -> ConfigLoaderImpl:
    return ConfigLoaderImpl(create_config_search_path(str(CONF)))


def message(error: Exception, typed: Sequence[str]) -> str:
    """Hydra's error about a configuration that cannot be composed from what the user typed, on one line."""
    if isinstance(error, MissingConfigException):
        group, _, name = str(error.missing_cfg_file).rpartition("/")
        choices = [option for option in error.options or () if not option.startswith("_")]  # what others share
        known = _suggested(name, choices) if choices else "; --sweep NAME lists the sweeps"
        if group == "head":
            words = [word.rpartition("@")[2].partition("=") for word in typed]
            group = next((key for key, _, values in words if key in HEADS and name in values.split(",")), group)
        return f"{group or 'config'}={name}: unknown{known}"
    if several := re.match(r"(Ambig|Sweep)[\w ]+ '(?:head@)?((.*?)=(.*))'(\n| requires)", str(error)):
        kind, override, key, value, _ = several.groups()
        key = key.lstrip("+~")
        config = _composed(typed, hydra=key.startswith("hydra."))
        if key not in _names(config) and not key.startswith("hydra/"):
            return unknown_option(key, config)
        known = f"; a list is {key}=[{value}]" if kind == "Ambig" else ""
        return f"{override}: several values are a sweep, add -m{known}"
    if unknown := re.match(r"Could not override '([\w.@/]+)'", str(error)):
        return unknown_option(unknown[1], _composed(typed, hydra=unknown[1].startswith("hydra.")))
    cause = f": {one_line(error.__cause__)}" if isinstance(error.__cause__, Exception) else ""
    return one_line(error).partition(" See https://hydra.cc")[0] + cause


def unknown_option(name: str, config: DictConfig) -> str:
    """What to type instead of an option that the configuration does not have."""
    if OmegaConf.select(config, name) is None and (suggested := hint(name, config)):
        return f"unknown option {name}{suggested}"
    group = name.rpartition(".")[0]
    while not isinstance(node := OmegaConf.select(config, group) if group else config, DictConfig):
        group = group.rpartition(".")[0]
    known = {key for key in map(str, node) if not key.startswith("_")} | {*(_groups() if not group else ())}
    return f"unknown option {name}; known: {', '.join(sorted(known - {name}))}"


def hint(name: str, config: DictConfig | None = None) -> str:
    """`; did you mean train.lr=...?` for what is the last part of an option, or close to an option or a group."""
    names, name = _names(_composed(()) if config is None else config), name.replace("-", "_")
    group, _, last = name.rpartition(".")
    same = [known for known in names if known.rpartition(".")[2] == last and (not group or group in known)]
    near = sorted(same, key=lambda known: known.count(".")) or get_close_matches(name, names, n=1, cutoff=0.8)
    found = [name] if name in names else near
    return f"; did you mean {' or '.join(f'{known}=...' for known in found[:SHOWN])}?" if found else ""


def _names(config: DictConfig) -> list[str]:
    """All options and groups."""
    options: Any = OmegaConf.to_container(config)
    return [*(name for name, _ in leaves(options)), *_groups()]


def _groups() -> list[str]:
    folders = [path.name for path in CONF.iterdir() if path.is_dir() and path.name not in ("hydra", "head")]
    return sorted([*folders, *HEADS])


def _composed(typed: Iterable[str], hydra: bool = False) -> DictConfig:
    """The configuration with the typed choices, or without them if they do not exist."""
    groups = (*_groups(), "head")
    choices = [word for word in typed if word.partition("=")[0].rpartition("@")[2] in groups and "," not in word]
    with contextlib.suppress(HydraException, OmegaConfBaseException):
        return _compose([*choices, *(word for word in typed if word.startswith("hydra/") and "," not in word)], hydra)
    return _compose([], hydra)


def _suggested(name: str, known: Sequence[str]) -> str:
    near = [one for one in known if one.lower() == name.lower()] or get_close_matches(name, known, n=1)
    return f"; {f'did you mean {near[0]}? ' if near else ''}known: {', '.join(known)}"
