"""A finished run's scene and model, as training left them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import nn

from qnerf.config.plugins import check_plugins
from qnerf.config.settings import Settings
from qnerf.experiment import build_model, prepare, ray_table
from qnerf.geometry.rays import RayTable
from qnerf.model.model import Model
from qnerf.quantum import QuantumLayer
from qnerf.records import read_config, state
from qnerf.records.checkpoints import load_archive
from qnerf.records.files import reporting
from qnerf.scenes import Scene
from qnerf.timing import Stopwatch
from qnerf.training.state_checks import check_integer, check_model, largest_state


@dataclass(frozen=True)
class Trained:
    """A finished run. The model is in evaluation mode, on the run's device and in its dtype."""

    folder: Path
    settings: Settings
    scene: Scene
    model: Model
    step: int

    @property
    def heads(self) -> dict[str, nn.Module]:
        return heads_of(self.model)

    def ray_table(self) -> RayTable:
        """The rays of the scene as training had them."""
        return ray_table(self.settings, self.scene)

    def stopwatch(self, model: Model) -> Stopwatch:
        """The stopwatch that a model needs to render."""
        return Stopwatch(self.settings.torch_device, model, QuantumLayer)


def heads_of(model: Model) -> dict[str, nn.Module]:
    return {"density": model.field.density_head, "color": model.field.color_head}


def circuits_of(head: nn.Module) -> dict[str, QuantumLayer]:
    """The circuits of a head, by their place in it."""
    return {name: module for name, module in head.named_modules() if isinstance(module, QuantumLayer)}


def load(run: str | Path, config: Mapping[str, Any] | None = None) -> Trained:
    """Builds the run's scene and model and loads its last checkpoint.

    Args:
        run: the run's folder.
        config: the configuration to use if the stored one is from an older version; None for the stored one.

    Raises:
        ValueError: not a finished run, or its scene or checkpoint cannot be read.
    """
    folder = Path(run)
    if not (folder / "config.yaml").is_file():
        raise ValueError(f"{folder} is not a run: it has no config.yaml")
    if state(folder) != "finished":
        raise ValueError(f"{folder}: expected a finished run, this one is {state(folder)}")
    if config is None:
        config = read_config(folder)
        check_plugins(folder, config.get("plugins", []), ())
    _, settings, scene = prepare(config)
    model = build_model(settings, scene)
    path = folder / "checkpoint.pt"
    with reporting(path, "read"):
        try:
            checkpoint = load_archive(path, largest_state(model, settings.train.steps))
            step = checkpoint["step"]
            check_integer("step", step, 0, settings.train.steps)
            check_model(checkpoint["model"], model.state_dict(), finite=True)
        except (OSError, MemoryError):
            raise
        except Exception as error:  # a damaged archive can raise anything
            reason = error if isinstance(error, ValueError) else type(error).__name__
            raise ValueError(f"{path}: expected the checkpoint of this run, got another: {reason}") from error
    model.load_state_dict(checkpoint["model"])
    model.field.encoder.progress = step / settings.train.steps
    return Trained(folder, settings, scene, model.eval(), step)
