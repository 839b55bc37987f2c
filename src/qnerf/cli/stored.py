"""A run of the store to go on with: `resume`, `reproduce`, `render`, `export`, `view` and `probe` begin with it."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml  # type: ignore[import-untyped]

from qnerf.cli import overrides as typed
from qnerf.cli import plugins
from qnerf.cli.ends import output_lost
from qnerf.cli.text import console
from qnerf.config.plugins import check_plugins
from qnerf.records import StoreError, read_config, read_summary

if TYPE_CHECKING:
    from qnerf.building.scene import Prepared
    from qnerf.experiment import Outcome
    from qnerf.probes import Trained

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


def stored(run: Path, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """The run's configuration with `overrides`.

    Raises:
        ValueError: an override of an option that decides the run's numbers; an option that this version does not have;
            plugins of the run that the overrides do not repeat.
    """
    from qnerf.building.acting import acting

    config = read_config(run)
    repeated = typed.plugins(overrides)
    check_plugins(run / "config.yaml", config.get("plugins", []), repeated)
    plugins.load(repeated)
    try:
        config = acting(config)
    except ValueError as error:
        raise StoreError(f"{run / 'config.yaml'}: {error}; the run was written by another version of qnerf") from error
    config["store"] = str(run.parent)
    for override in overrides:
        key, _, text = override.partition("=")
        if key == "plugins":
            continue
        if key not in CHANGEABLE:
            raise ValueError(f"{override}: cannot change what the run computes; known: {', '.join(CHANGEABLE)}")
        *groups, last = key.split(".")
        node = config.setdefault(groups[0], {}) if groups else config
        node[last] = _value(override, text)
    return config


def run_stored(run: Path, config: dict[str, Any], name: str | None = None) -> "Outcome":
    """Trains with the stored `config`, which may be changed in `CHANGEABLE` options, and shows the progress.

    name: the run's id, to continue it; None: the id of the configuration.

    Raises:
        ValueError: the scene or the stored configuration has changed; the training diverged.
    """
    from qnerf import experiment
    from qnerf.building.scene import prepare
    from qnerf.cli.display import LiveDisplay
    from qnerf.training.trainer import Diverged

    check_identity(run, prepare(config))
    display = LiveDisplay(console(), live=config.get("run", {}).get("progress", True))
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
    from qnerf.building.scene import prepare
    from qnerf.probes import load, require_loadable

    require_loadable(run, unfinished=unfinished)
    prepared = prepare(stored(run, overrides))
    check_identity(run, prepared)
    return load(run, prepared, unfinished=unfinished)


def check_identity(run: Path, prepared: "Prepared") -> None:
    """ValueError if the stored configuration or the scene's contents have changed since the run was started."""
    from qnerf.building.acting import run_id

    scene = prepared.scene
    if run.name.endswith(run_id(prepared.config, scene.fingerprint)[-11:]):
        return
    if read_summary(run).get("scene.fingerprint") == scene.fingerprint:
        raise StoreError(f"{run / 'config.yaml'} is not the configuration that the run was started with")
    path = prepared.config["scene"].get("path")
    raise StoreError(
        f"{run}: scene.path={path}: the scene's contents are not those that the run was started with (docs/runs.md)"
    )


def _value(override: str, text: str) -> Any:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        raise ValueError(f"{override}: expected key=value") from None
