"""The stored configuration of a run in today's form: `resume`, `reproduce`, `replay` and `probe` begin with it.

Runs outlive versions. Renamed options get today's names. Options that are newer than the run get the value that does
what it did (`compatibility.ADDED`), else today's default, which is reported. Options that no longer exist are refused.
The run keeps its id.
"""

import copy
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml  # type: ignore[import-untyped]

from qnerf.cli import overrides as typed
from qnerf.cli import plugins
from qnerf.cli.ends import output_lost
from qnerf.cli.text import console
from qnerf.config.compatibility import fill_added, today_noted
from qnerf.config.folders import CONF
from qnerf.config.identity import identity
from qnerf.config.plugins import check_plugins
from qnerf.config.settings import only_acting
from qnerf.records import StoreError, read_config, read_status

if TYPE_CHECKING:
    from qnerf.experiment import Outcome
    from qnerf.probes import Trained
    from qnerf.scenes import Scene
    from qnerf.signals import Signal

CHANGEABLE = (
    "threads",
    "device",
    "run.progress",
    "run.preview_seconds",
    "run.debug",
    "numerics.finite_checks",
    "scene.path",
)
"""Options that may differ from the stored ones: how the run is executed, and where its scene is now."""
GROUPS = {
    **{group: group for group in ("encoder", "scene", "sampler", "shading", "cameras", "train")},
    "density": "head@density",
    "color": "head@color",
    "head": "head",
}
"""Part of the configuration whose `name` decides its options -> the config group that offers it."""
OPAQUE = "ansatz_options"  # its options depend on the names in it


def stored(run: Path, overrides: Sequence[str] = ()) -> tuple[dict[str, Any], list[str]]:
    """The run's complete configuration with `overrides`, and the options that got today's default, as key=value.

    Raises:
        ValueError: an override of an option that decides the run's numbers; an option that no longer exists; plugins of
            the run that the overrides do not repeat.
    """
    config = read_config(run)
    filled = fill(config, run / "config.yaml", overrides)
    config["store"] = str(run.parent)
    config["run"]["force"] = False  # even if the run was started with it
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


def fill(config: dict[str, Any], file: Path, overrides: Sequence[str]) -> list[str]:
    """Imports the run's plugins and adds the options that its configuration, read from `file`, lacks.

    Returns the options that got today's default, as key=value. ValueError as for `stored`.
    """
    repeated = typed.plugins(overrides)
    check_plugins(file, config.get("plugins", []), repeated)
    plugins.load(repeated)
    if isinstance(config.get("numerics"), str):  # from before it was a group
        config["numerics"] = {"dtype": config["numerics"]}
    fill_added(config)
    for group in config.keys() - only_acting(config).keys():
        del config[group]
    return complete(config, todays_defaults(config), str(file))


def run_stored(run: Path, config: dict[str, Any], filled: Sequence[str], name: str | None = None) -> "Outcome":
    """Trains with the stored `config`, which may be changed in `CHANGEABLE` options, and shows the progress.

    name: the run's id, to continue it; None: today's id of the configuration.

    Raises:
        ValueError: the scene or the stored configuration has changed; the training diverged.
    """
    from qnerf import experiment
    from qnerf.building.scene import scene_of
    from qnerf.cli.display import LiveDisplay
    from qnerf.training.trainer import Diverged

    check_identity(run, scene_of(config), config["scene"].get("path"))
    display = LiveDisplay(console(), live=config["run"]["progress"])
    if filled:
        display.note(f"the run is older than some options, which have today's defaults: {', '.join(filled)}")
    try:
        return experiment.run(config, (), display, output_lost, name=name)
    except Diverged as error:
        raise ValueError(str(error)) from error


def load_stored(run: Path, overrides: Sequence[str] = (), *, unfinished: bool = True) -> "Trained":
    """The model of a run's last checkpoint, with its scene.

    unfinished: also of a run that is being trained or was interrupted.

    Raises:
        ValueError: as for `stored`, `check_identity` and `qnerf.probes.load`.
    """
    from qnerf.probes import load, require_loadable

    require_loadable(run, unfinished=unfinished)
    trained = load(run, stored(run, overrides)[0], unfinished=unfinished)
    check_identity(run, trained.scene, trained.settings.scene.get("path"))
    return trained


def check_identity(run: Path, scene: "Scene | Signal", path: str | Path | None) -> None:
    """ValueError if the stored configuration or the scene's contents have changed since the run was started.

    path: from which the scene was read, for the message.
    """
    config = read_config(run)
    if run.name.endswith(f"-{identity(config, scene.fingerprint)}"):
        return
    known = read_status(run).get("config")
    edited = f"{run / 'config.yaml'} is not the configuration that the run was started with"
    moved = f"scene.path={path}: the scene's contents are not those that the run was started with (docs/runs.md)"
    if known is None:
        raise StoreError(f"{run}: either {edited}, or {moved}")
    raise StoreError(f"{run}: {moved if known == identity(config) else edited}")


def complete(config: dict[str, Any], today: Mapping[str, Any], label: str) -> list[str]:
    """Adds to `config` the options that only `today` has and returns them as key=value.

    ValueError names the options that only `config` has.
    """
    for key in config.keys() & today.keys():
        if isinstance(today[key], Mapping) and not isinstance(config[key], Mapping):
            raise ValueError(f"{label}: expected options of {key}, got {config[key]!r}")
    missing, unknown = list(_only_in(today, config)), list(_only_in(config, today))
    # conf/ has neither the stored `auto` decisions nor the options of single contractions.
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
    """Paths of the keys that `one` has and `other` lacks."""
    for key, value in one.items():
        if key not in other:
            yield (*path, key)
        elif isinstance(value, Mapping) and isinstance(other[key], Mapping) and key != OPAQUE:
            yield from _only_in(value, other[key], (*path, key))


def todays_defaults(config: Mapping[str, Any]) -> dict[str, Any]:
    """The defaults in conf/ for the same choice of every group in `GROUPS`."""
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf

    import qnerf.cli.resolvers  # noqa: F401

    choices = {
        group: node.get("name") for part, group in GROUPS.items() if isinstance(node := config.get(part), Mapping)
    }
    known = [f"{group}={name}" for group, name in choices.items() if plugins.is_choice(group.partition("@")[0], name)]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        defaults: dict[str, Any] = OmegaConf.to_container(compose("config", known), resolve=True)  # type: ignore[assignment]
    return only_acting(defaults)


def _value(override: str, text: str) -> Any:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        raise ValueError(f"{override}: expected key=value") from None
