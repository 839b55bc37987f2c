"""A configuration with its scene: `auto` resolved, settings checked, the id of the run."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from qnerf import auto
from qnerf.building.components import check_components, component
from qnerf.config.identity import run_id
from qnerf.config.plugins import import_plugins
from qnerf.config.settings import (
    Settings,
    SignalSettings,
    check_settings,
    schema,
    settings_from,
    signal_settings_from,
)
from qnerf.geometry.pose_noise import add_pose_noise
from qnerf.model.labels import slug
from qnerf.records import StoreError, read_config
from qnerf.scenes import SCENES, Scene
from qnerf.signals import Signal


def prepare_signal(config: Mapping[str, Any]) -> tuple[SignalSettings, Signal]:
    """The settings of a configuration that fits a signal with one head, and the signal; ValueError as `prepare`."""
    check_settings(config)
    import_plugins(config["plugins"])
    check_components(config)
    return signal_settings_from(config), component(SCENES, config["scene"])


def prepare(config: Mapping[str, Any], *, begun: bool = False) -> tuple[dict[str, Any], Settings, Scene]:
    """The configuration with every `auto` resolved for its scene, its settings, and the scene.

    begun: if the run exists in its store, reuse its stored `auto` decisions.

    Raises:
        ValueError: an option with a value that it cannot have, a scene that cannot be read, or a signal.
    """
    if schema(config) is not Settings:
        raise ValueError("expected a radiance field; the configuration has one head, which fits a signal")
    undecided = auto.asked(config)
    check_settings(config, undecided)
    import_plugins(config["plugins"])
    check_components(config, undecided)
    if not undecided:
        settings = settings_from(config)
        return dict(config), settings, build_scene(settings)
    scene = add_pose_noise(component(SCENES, config["scene"]), **config["pose_noise"])
    if begun and not config["run"]["force"]:
        config = {**config, "needs": {**needs_of(config, scene), **config["needs"]}}
    scene.require_training_pixels()
    resolved = auto.resolve(config, scene)
    settings = settings_from(resolved)
    check_components(resolved)
    check_background(scene, settings)
    return resolved, settings, scene


def scene_of(config: Mapping[str, Any]) -> Scene | Signal:
    """The scene of a configuration; ValueError as `prepare`."""
    return prepare_signal(config)[1] if schema(config) is SignalSettings else prepare(config)[2]


def needs_of(config: Mapping[str, Any], scene: Scene) -> dict[str, Any]:
    """The stored `auto` decisions of this configuration's run; empty if there is no run yet."""
    try:
        stored = read_config(Path(config["store"]) / id_of(config, scene))
    except StoreError:
        return {}
    return dict(stored.get("needs") or {})


def id_of(config: Mapping[str, Any], scene: Scene | Signal) -> str:
    """The id of the configuration's run."""
    return run_id(slug(config), config, scene.fingerprint)


def build_scene(settings: Settings) -> Scene:
    scene = add_pose_noise(component(SCENES, settings.scene), **vars(settings.pose_noise))
    check_background(scene, settings)
    return scene


def check_background(scene: Scene, settings: Settings) -> None:
    if scene.has_alpha and settings.render.background == "last_sample":
        raise ValueError(
            f"scene {scene.name}: the images have alpha, which render.background=last_sample cannot be compared with; "
            "use render.background=white, black or random"
        )
