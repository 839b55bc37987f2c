"""A configuration with its scene: `auto` decided, settings checked, the id of the run."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qnerf import auto
from qnerf.building.components import component
from qnerf.building.configuration import Configuration
from qnerf.building.field import FieldTask
from qnerf.config import bounds
from qnerf.config.plugins import import_plugins
from qnerf.config.settings import Settings
from qnerf.records.read import read_status
from qnerf.scenes import Scene
from qnerf.signals import SCENES
from qnerf.training.task import Task


@dataclass(frozen=True)
class Prepared:
    """What a run starts from.

    source: the scene as it was read, for `prepare`. decisions: the options that were `auto`.
    """

    configuration: Configuration
    source: Scene | Task
    task: Task
    decisions: Mapping[str, auto.Decision]

    @property
    def settings(self) -> Any:
        return self.configuration.settings

    @property
    def scene(self) -> Any:
        return self.task.scene

    def of_field(self) -> tuple[Settings, Scene]:
        """Settings and scene of a radiance field; ValueError if it is another task."""
        if not isinstance(self.settings, Settings) or not isinstance(self.scene, Scene):
            name = self.configuration["scene.name"]
            raise ValueError(f"expected a radiance field; scene={name} is none")
        return self.settings, self.scene

    def find_id(self, store: str | Path) -> str:
        """The id of the run, or the one that the store has for it where the scene was renamed since.

        A copy, a backup or anything else of a user whose name ends with the hash is not the run.
        """
        name = self.configuration.run_id(self.task.fingerprint)
        others = sorted(Path(store).glob(f"*-{name.rpartition('-')[2]}"))
        if any(path.name == name for path in others):
            return name
        return next((path.name for path in others if read_status(path).get("run_id") == path.name), name)


def prepare(config: Mapping[str, Any] | Configuration, source: Scene | Task | None = None) -> Prepared:
    """Reads the scene and decides every `auto` for it.

    source: what the group `scene` names, if it has been read already.

    Raises:
        ValueError: an option with a value that it cannot have, or a scene that cannot be read.
    """
    if not isinstance(config, Configuration):
        import_plugins(config.get("plugins", []))
    configuration = Configuration.of(config)  # before the scene is read, which may take long
    node = dict(configuration.complete["scene"])
    share = node.pop("validation")
    source = component(SCENES, node) if source is None else source
    if not isinstance(source, Scene | Task):
        raise ValueError(f"scene={node['name']}: expected a Scene or a Task, got {type(source).__name__}")
    chosen = source.validating(share) if share else source
    task = FieldTask(chosen) if isinstance(chosen, Scene) else chosen
    configuration, decisions = task.decide(configuration)
    for option in configuration.options:
        if option.value == auto.AUTO:  # and nothing has decided it
            bounds.check(option.name, option.value, option.hint)
    return Prepared(configuration, source, task, decisions)
