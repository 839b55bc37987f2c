"""Stored runs, taken up again: `resume`, `reproduce`, `probe` and what shows a trained model begin with it.

The stored configuration is complete. Only how it is executed may differ, and where its scene is now.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml  # type: ignore[import-untyped]

from qnerf.cli import plugins
from qnerf.cli.text import console
from qnerf.config.plugins import check_plugins
from qnerf.records import StoreError, read_config, read_summary

if TYPE_CHECKING:
    from qnerf.building.configuration import Configuration
    from qnerf.building.scene import Prepared
    from qnerf.experiment import Outcome
    from qnerf.probes import Trained

CHANGEABLE = ("scene.path", "threads", "device", "run.progress", "run.capture", "run.preview_seconds", "run.hours")
"""Options that may differ from the stored ones: how the run is executed, and where its scene is now."""


def split(words: Iterable[str]) -> tuple[list[str], list[str]]:
    """Words that are no overrides of a stored run, and those that are, or seem to be: `stored` refuses the others."""
    own: tuple[list[str], list[str]] = [], []
    for word in words:
        key, equals, _ = word.partition("=")
        dotted = "." in key and key.replace(".", "").isidentifier()
        own[bool(equals) and (dotted or key in (*CHANGEABLE, "plugins"))].append(word)
    return own


def stored(run: Path, overrides: Sequence[str] = ()) -> "Configuration":
    """The run's complete configuration with `overrides`; imports the run's plugins.

    Raises:
        ValueError: an override of an option that decides the run's numbers; an option that this version does not have;
            plugins of the run that the overrides do not repeat.
    """
    from qnerf.building.configuration import Configuration
    from qnerf.cli import compose

    config, file = read_config(run), run / "config.yaml"
    if not isinstance(config.get("scene", {}), dict) or "train" not in config:
        raise StoreError(f"{run}: was trained by a loop of its own, with qnerf.track; only that loop goes on with it")
    plugins_again = compose.plugins(overrides)
    check_plugins(file, config.get("plugins", []), plugins_again)
    plugins.load(plugins_again)
    try:
        configuration = Configuration.of(config)
    except ValueError as error:
        raise StoreError(f"{file}: {error}; it was written by another version of qnerf") from error
    values: dict[str, Any] = {"store": str(run.parent)}
    for override in overrides:
        key, _, text = override.partition("=")
        if key == "plugins":
            continue
        if key not in CHANGEABLE:
            raise ValueError(f"{override}: cannot change what the run computes; known: {', '.join(CHANGEABLE)}")
        values[key] = _value(override, text)
    return configuration.with_values(values)


def run_stored(run: Path, configuration: "Configuration", name: str | None = None) -> "Outcome":
    """Trains with the stored configuration, which may be changed in `CHANGEABLE` options.

    name: the run's id, to continue it. ValueError where the scene or the stored configuration has changed.
    """
    from qnerf import experiment
    from qnerf.cli.display import LiveDisplay

    prepared = _prepared(run, configuration)
    display = LiveDisplay(console(), live=configuration["run.progress"])
    return experiment.run(prepared, (), display, name)


def load_stored(run: Path, overrides: Sequence[str] = (), *, unfinished: bool = True) -> "Trained":
    """The model of a run's last checkpoint, with its scene; ValueError as of `stored`, `_prepared` and
    `qnerf.probes.load`."""
    from qnerf.probes import load, require_loadable

    configuration = stored(run, overrides)
    require_loadable(run, unfinished=unfinished)
    return load(run, _prepared(run, configuration), unfinished=unfinished)


def _prepared(run: Path, configuration: "Configuration") -> "Prepared":
    """The configuration with its scene, which must be the run's own."""
    from qnerf.building.scene import prepare

    path = configuration.complete["scene"].get("path")
    try:
        prepared = prepare(configuration)
    except ValueError as error:
        if path and not Path(path).exists():
            raise ValueError(f"{error}; if the scene has moved, add scene.path=DIR") from error
        raise
    check_identity(run, prepared)
    return prepared


def check_identity(run: Path, prepared: "Prepared") -> None:
    """ValueError if the stored configuration or the scene's contents have changed since the run was started."""
    fingerprint = prepared.task.fingerprint
    if run.name.rpartition("-")[2] == prepared.configuration.run_id(fingerprint).rpartition("-")[2]:
        return
    if read_summary(run).get("scene.fingerprint") == fingerprint:
        raise StoreError(f"{run / 'config.yaml'} is not the configuration that the run was started with")
    path = prepared.configuration.acting["scene"].get("path")
    raise StoreError(
        f"{run}: scene.path={path}: the scene's contents are not those that the run was started with (docs/runs.md)"
    )


def _value(override: str, text: str) -> Any:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        raise ValueError(f"{override}: expected key=value") from None
