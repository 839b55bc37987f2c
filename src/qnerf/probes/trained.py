"""A finished run's scene and model, as training left them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qnerf.config.plugins import check_plugins
from qnerf.config.settings import Settings
from qnerf.experiment import build_model, prepare
from qnerf.model.model import Model
from qnerf.records import read_config, state
from qnerf.records.checkpoints import load_archive
from qnerf.records.files import reporting
from qnerf.scenes import Scene


@dataclass(frozen=True)
class Trained:
    """The model is in evaluation mode, on the run's device, in the run's dtype."""

    folder: Path
    settings: Settings
    scene: Scene
    model: Model
    step: int


def load(run: str | Path, config: Mapping[str, Any] | None = None) -> Trained:
    """Builds the run's scene and model and fills in its last checkpoint.

    config: the run's configuration where the stored one is older than this version; None: as stored.

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
            checkpoint = load_archive(path)
            model.load_state_dict(checkpoint["model"])
            step = int(checkpoint["step"])
        except OSError:
            raise
        except Exception as error:  # whatever a damaged archive makes its readers raise
            raise ValueError(f"{path}: expected the checkpoint of this run, got {type(error).__name__}") from error
    model.field.encoder.progress = step / settings.train.steps
    return Trained(folder, settings, scene, model.eval(), step)
