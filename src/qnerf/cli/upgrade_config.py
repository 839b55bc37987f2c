"""The stored configuration of a run in today's form: what `resume`, `reproduce` and `probe` begin with.

Runs outlive versions. Renamed options get today's names. Options that did not exist when a run was started get the
value that stands for what it did (`compatibility.ADDED`), else today's default, which is reported. Options that exist
no longer are refused. The id stays that of the stored configuration.
"""

import copy
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]

from qnerf.cli import overrides as typed
from qnerf.cli import plugins
from qnerf.config.compatibility import fill_added, today_noted
from qnerf.config.folders import CONF
from qnerf.config.identity import identity
from qnerf.config.plugins import check_plugins
from qnerf.records import StoreError, read_config, read_status

CHANGEABLE = ("threads", "device", "run.progress", "run.debug", "numerics.finite_checks", "scene.path")
"""What may differ from the stored configuration: how it is executed, and where the same scene lies now."""
GROUPS = {
    **{group: group for group in ("encoder", "scene", "sampler", "shading", "cameras", "train")},
    "density": "head@density",
    "color": "head@color",
}
"""Part of the configuration whose `name` decides which options there are -> the group that it is chosen from."""
OPAQUE = "ansatz_options"  # which options are in it depends on the names in it


def stored(run: Path, overrides: Sequence[str] = ()) -> tuple[dict[str, Any], list[str]]:
    """The run's complete configuration with `overrides`, for the store that it lies in; and the options that got
    today's default, as key=value.

    Raises:
        ValueError: an override of what makes the run what it is; an option that is known no longer; plugins of the run
            that the overrides do not repeat.
    """
    config = read_config(run)
    repeated = typed.plugins(overrides)
    check_plugins(run, config.get("plugins", []), repeated)
    plugins.load(repeated)
    if isinstance(config.get("numerics"), str):  # before it was a group
        config["numerics"] = {"dtype": config["numerics"]}
    fill_added(config)
    filled = complete(config, todays_defaults(config), f"{run / 'config.yaml'}")
    config["store"] = str(run.parent)
    config["run"]["force"] = False  # the run may have been started with it, but is not to be thrown away now
    for override in overrides:
        key, _, text = override.partition("=")
        if key == "plugins":
            continue
        key = today_noted(key)
        if key not in CHANGEABLE:
            raise ValueError(f"{override}: cannot change what the run computes; known: {', '.join(CHANGEABLE)}")
        *groups, last = key.split(".")
        node = config[groups[0]] if groups else config
        node[last] = _value(override, text)
    return config, filled


def check_identity(run: Path, fingerprint: str) -> None:
    """ValueError unless the stored configuration and the scene's contents are still those that the run is named by."""
    config = read_config(run)
    if run.name.endswith(f"-{identity(config, fingerprint)}"):
        return
    known = read_status(run).get("config")
    path = config.get("scene", {}).get("path")
    edited = f"{run / 'config.yaml'} is not the configuration that the run was started with"
    moved = f"scene.path={path}: the scene's contents are not those that the run was started with"
    if known is None:
        raise StoreError(f"{run}: either {edited}, or {moved}")
    raise StoreError(f"{run}: {moved if known == identity(config) else edited}")


def complete(config: dict[str, Any], today: Mapping[str, Any], label: str) -> list[str]:
    """Adds to `config` what only `today` has; returns it as key=value. ValueError names what only `config` has."""
    for key in config.keys() & today.keys():
        if isinstance(today[key], Mapping) and not isinstance(config[key], Mapping):
            raise ValueError(f"{label}: expected options of {key}, got {config[key]!r}")
    missing, unknown = list(_only_in(today, config)), list(_only_in(config, today))
    # conf/ spells out neither what a scene was found to need nor what only some contractions have.
    also = {("contraction", option) for option in _contraction_options(config)}
    unknown = [path for path in unknown if path[0] != "needs" and path not in also]
    if unknown:
        names = ", ".join(".".join(path) for path in unknown)
        raise ValueError(f"{label}: written by another version of qnerf; this one has no option {names}")
    filled = []
    for *groups, last in missing:
        node, source = config, today
        for group in groups:
            node, source = node[group], source[group]
        node[last] = copy.deepcopy(source[last])
        filled.append(f"{'.'.join([*groups, last])}={source[last]}")
    return filled


def _contraction_options(config: Mapping[str, Any]) -> Collection[str]:
    from qnerf.geometry.contraction import CONTRACTIONS

    name = config.get("contraction", {}).get("name")
    return CONTRACTIONS.options(name) if name in CONTRACTIONS.names() else ()


def _only_in(one: Mapping[str, Any], other: Mapping[str, Any], path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Paths of the keys that `one` has and `other` has not."""
    for key, value in one.items():
        if key not in other:
            yield (*path, key)
        elif isinstance(value, Mapping) and isinstance(other[key], Mapping) and key != OPAQUE:
            yield from _only_in(value, other[key], (*path, key))


def todays_defaults(config: Mapping[str, Any]) -> dict[str, Any]:
    """What conf/ gives for the same choice of every group whose choice decides which options there are."""
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf

    choices = {
        group: node.get("name") for part, group in GROUPS.items() if isinstance(node := config.get(part), Mapping)
    }
    known = [f"{group}={name}" for group, name in choices.items() if plugins.is_choice(group.partition("@")[0], name)]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        defaults: dict[str, Any] = OmegaConf.to_container(compose("config", known), resolve=True)  # type: ignore[assignment]
    return defaults


def _value(override: str, text: str) -> Any:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        raise ValueError(f"{override}: expected key=value") from None
