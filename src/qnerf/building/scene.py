"""A configuration with its scene: `auto` decided, settings checked, the id of the run."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qnerf import auto
from qnerf.building.acting import acting, complete, run_id, settings_of
from qnerf.building.components import component
from qnerf.config.plugins import import_plugins
from qnerf.config.settings import PoseNoise, Settings, SignalSettings, built
from qnerf.geometry.bounds import bounds_of
from qnerf.geometry.pose_noise import add_pose_noise
from qnerf.records.read import read_status
from qnerf.scenes import SCENES, Scene
from qnerf.signals import Signal


@dataclass(frozen=True)
class Prepared:
    """What a run starts from. `config` is what acts; `decisions` are the options that were `auto`."""

    config: dict[str, Any]
    settings: Settings | SignalSettings
    scene: Scene | Signal
    decisions: dict[str, auto.Decision]

    def of_field(self) -> tuple[Settings, Scene]:
        """Settings and scene of a radiance field; ValueError if it is a signal, which one head fits."""
        if not isinstance(self.settings, Settings) or not isinstance(self.scene, Scene):
            raise ValueError(f"expected a radiance field; scene={self.config['scene']['name']} is fitted by one head")
        return self.settings, self.scene

    def find_id(self, store: str | Path) -> str:
        """The id of the run, or the one that the store has for it where the scene was renamed since.

        A copy, a backup or anything else of a user whose name ends with the hash is not the run.
        """
        name = run_id(self.config, self.scene.fingerprint)
        others = sorted(Path(store).glob(f"*-{name.rpartition('-')[2]}"))
        if any(path.name == name for path in others):
            return name
        return next((path.name for path in others if read_status(path).get("run_id") == path.name), name)


def prepare(config: Mapping[str, Any], scene: Scene | Signal | None = None) -> Prepared:
    """Reads the scene and decides every `auto` for it.

    scene: what the group `scene` names, if it has been read already.

    Raises:
        ValueError: an option with a value that it cannot have, or a scene that cannot be read.
    """
    import_plugins(config.get("plugins", []))
    checked = complete(config)  # before the scene is read, which may take long
    scene = component(SCENES, checked["scene"]) if scene is None else scene
    if not isinstance(scene, Scene | Signal):
        name = checked["scene"]["name"]
        raise ValueError(f"scene={name}: expected a Scene or a Signal, got {type(scene).__name__}")
    decisions: dict[str, auto.Decision] = {}
    if isinstance(scene, Signal):
        scene.check()
    if isinstance(scene, Scene):
        scene = add_pose_noise(scene, **vars(built(PoseNoise, checked.get("pose_noise", {}))))
        scene.require_pixels()
        checked, decisions = auto.resolve(checked, scene)
    settings = settings_of(checked)
    if isinstance(scene, Scene):
        assert isinstance(settings, Settings)
        check_background(scene, settings)
        bounds_of(scene, settings.render.near, settings.render.far)
        # With bounds that hold anyway, and without them, it is one run.
        implied = dict(zip(("near", "far"), bounds_of(scene, None, None), strict=True))
        checked["render"] = {key: value for key, value in checked["render"].items() if implied.get(key) != value}
    return Prepared(acting(checked), settings, scene, decisions)


def check_background(scene: Scene, settings: Settings) -> None:
    if scene.has_alpha and settings.render.background == "last_sample":
        raise ValueError(
            f"scene {scene.name}: the images have alpha, which render.background=last_sample cannot be compared with; "
            "use render.background=white, black or random"
        )
