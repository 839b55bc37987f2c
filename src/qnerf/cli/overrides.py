"""Translates what the user typed before Hydra reads it: old names of options, short forms, plugins."""

import re
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn

from qnerf.config.folders import CONF

_OVERRIDE = re.compile(r"(?P<sign>~|\+\+|\+)?(?P<key>[A-Za-z_][\w./-]*)(?P<package>@[^=]*)?(?P<value>=.*)?", re.DOTALL)
_SWEPT = "hydra.sweeper.params."
_HEADS = ("density", "color")


def translated(arguments: Iterable[str]) -> list[str]:
    """Each override as Hydra expects it. Other arguments stay as they are.

    >>> translated(["-m", "density=qiren,mlp", "stop.min_gain_db=0.1"])
    ['-m', 'head@density=qiren,mlp', 'stop.min_gain_db=0.1']
    """
    return [_translated(argument) for argument in arguments]


def _translated(argument: str) -> str:
    match = _OVERRIDE.fullmatch(argument)
    if match is None or not (match["sign"] or match["value"]):
        return argument
    sign, package, value = match["sign"] or "", match["package"] or "", match["value"] or ""
    return f"{sign}{option(match['key'], value)}{package}{value}"


def option(key: str, value: str = "") -> str:
    """Hydra's key for what the user calls `key`. `value` begins with = unless it is empty.

    >>> option("density", "=qiren"), option("seed", "=1")
    ('head@density', 'seed')
    """
    if key.startswith(_SWEPT):
        return _SWEPT + option(key.removeprefix(_SWEPT), value)
    if key in _HEADS and not value.startswith("={"):
        return f"head@{key}"
    return key


def ordered(arguments: Sequence[str]) -> tuple[list[str], dict[str, Any]]:
    """Hydra's own options before the overrides, because Hydra wants them so, and the values of those options.

    >>> ordered(["seed=0", "-m", "field=qcolor"])[0]
    ['-m', 'seed=0', 'field=qcolor']

    Raises:
        ValueError: an option that Hydra does not have, or one without its value.
    """
    from hydra._internal.utils import get_args_parser

    parser = get_args_parser()
    parser.error = _refuse  # type: ignore[method-assign]
    parsed = vars(parser.parse_intermixed_args(list(arguments)))
    rest, overrides = list(arguments), list(parsed["overrides"])
    for override in overrides:
        rest.remove(override)
    return rest + overrides, parsed


def _refuse(message: str) -> NoReturn:
    raise ValueError(message)


def check(arguments: Iterable[str]) -> None:
    """ValueError for an override without an option, and for a group that is set to what is no name of a choice.

    >>> check(["=1"])
    Traceback (most recent call last):
        ...
    ValueError: '=1': expected OPTION=VALUE
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    for argument in arguments:
        if re.match(r"[~+]*(=|$)", argument):
            raise ValueError(f"{argument!r}: expected OPTION=VALUE")
        match = _OVERRIDE.fullmatch(argument)
        if match is None or not match["value"] or match["sign"] == "~" or not (CONF / match["key"]).is_dir():
            continue
        try:
            override = OverridesParser.create().parse_override(argument)
        except (HydraException, RecursionError):
            continue  # Hydra will say so
        value = override.value()
        names = value if isinstance(value, list) else [value]
        if not override.is_sweep_override() and not all(isinstance(name, str) for name in names):
            known = sorted(file.stem for file in (CONF / match["key"]).glob("*.yaml") if file.stem != "base")
            raise ValueError(f"{argument}: expected the name of a choice; known: {', '.join(known)}")


def plugins(arguments: Sequence[str]) -> list[str]:
    """The modules of `plugins=[a,b]`, if any. ValueError if it is not a list of names."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    names: list[str] = []
    for argument in arguments:
        if argument.lstrip("+").startswith("plugins="):
            try:
                value = OverridesParser.create().parse_override(argument).value()
            except (HydraException, RecursionError):
                value = None
            if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
                raise ValueError(f"{argument[:80]}: expected a list of modules, such as plugins=[my_module]")
            names = value
    return names
