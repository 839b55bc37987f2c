"""A run's scene and model, as its last checkpoint has them."""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor, nn

from qnerf.building.model import build_model, ray_table
from qnerf.building.scene import Prepared, prepare
from qnerf.config.plugins import check_plugins
from qnerf.config.settings import Settings
from qnerf.geometry.rays import RayTable
from qnerf.model.model import Model
from qnerf.quantum import QuantumLayer
from qnerf.quantum.hardware_conditions import CURE
from qnerf.records import read_config, state
from qnerf.records.checkpoints import load_archive
from qnerf.records.files import reporting
from qnerf.rendering.background import evaluation_background
from qnerf.scenes import Scene
from qnerf.timing import Stopwatch
from qnerf.training.schedules import paced
from qnerf.training.state_checks import check_shapes

Key = TypeVar("Key")
Seen = TypeVar("Seen")


@dataclass(frozen=True)
class Trained:
    """A run. The model is in evaluation mode, on the run's device and in its dtype."""

    folder: Path
    settings: Settings
    scene: Scene
    model: Model
    step: int

    def reloaded(self) -> "Trained":
        """The same run with what its checkpoint holds now; the model is changed in place.

        Raises:
            ValueError: the checkpoint cannot be read or is not of this run. The model stays as it is.
        """
        path, model = self.folder / "checkpoint.pt", self.model
        with reporting(path, "read"):
            try:
                checkpoint = load_archive(path)
                step = checkpoint["step"]
                check_shapes("model", checkpoint["model"], model.state_dict())
            except (OSError, MemoryError):
                raise
            except Exception as error:  # a damaged archive can raise anything
                reason = error if isinstance(error, ValueError) else type(error).__name__
                raise ValueError(f"{path}: expected the checkpoint of this run, got another: {reason}") from error
        model.load_state_dict(checkpoint["model"])
        for part in paced(model):
            part.progress = step / self.settings.train.steps
        return replace(self, step=step)

    @property
    def heads(self) -> dict[str, nn.Module]:
        return heads_of(self.model)

    def ray_table(self) -> RayTable:
        """The rays of the scene as training had them."""
        return ray_table(self.settings, self.scene)

    def stopwatch(self, model: Model) -> Stopwatch:
        """The stopwatch that a model needs to render."""
        return Stopwatch(self.settings.torch_device, model, QuantumLayer)

    def circuits(self) -> dict[str, dict[str, QuantumLayer]]:
        """Head -> its circuits by their place in it, for heads with circuits. ValueError if no head has one."""
        circuits = {name: found for name, head in self.heads.items() if (found := circuits_of(head))}
        if not circuits:
            raise ValueError(f"{self.folder}: neither of its heads has a circuit of qnerf (QuantumLayer); {CURE}")
        return circuits

    @torch.no_grad()
    def watched(
        self,
        model: Model,
        modules: Mapping[Key, nn.Module],
        see: Callable[[Tensor, Tensor], Seen],
        rays: int,
        step: int,
    ) -> dict[Key, list[Seen]]:
        """What `see(input, output)` gives for each call of each module, while training rays are rendered.

        They are the same random rays each time.
        """
        seen: dict[Key, list[Seen]] = {key: [] for key in modules}
        table = self.ray_table()
        batch, _ = table.batch(table.draw(rays, torch.Generator().manual_seed(0)), model.cameras)
        background = evaluation_background(self.settings.render.background)
        with ExitStack() as hooks:
            for key, module in modules.items():

                def watch(_: nn.Module, inputs: tuple[Tensor, ...], out: Tensor, key: Key = key) -> None:
                    seen[key].append(see(inputs[0], out))

                hooks.callback(module.register_forward_hook(watch).remove)
            model(batch, background=background, step=step, watch=self.stopwatch(model))
        return seen


def heads_of(model: Model) -> dict[str, nn.Module]:
    return {"density": model.field.density_head, "color": model.field.color_head}


def circuits_of(head: nn.Module) -> dict[str, QuantumLayer]:
    """The circuits of a head, by their place in it."""
    return {name: module for name, module in head.named_modules() if isinstance(module, QuantumLayer)}


def require_loadable(folder: Path, *, unfinished: bool = False) -> None:
    """ValueError unless the folder is a finished run; unfinished: a run with a checkpoint."""
    if not (folder / "config.yaml").is_file():
        raise ValueError(f"{folder} is not a run: it has no config.yaml")
    if not unfinished and state(folder) != "finished":
        raise ValueError(f"{folder}: expected a finished run, this one is {state(folder)}")
    if unfinished and not (folder / "checkpoint.pt").exists():
        raise ValueError(f"{folder}: this run is {state(folder)} and has no checkpoint")


def load(run: str | Path, prepared: Prepared | None = None, *, unfinished: bool = False) -> Trained:
    """Builds the run's scene and model and loads its last checkpoint.

    prepared: the run's configuration and scene, if they are read already. unfinished: take also the checkpoint of a run
    that is being trained, or was interrupted. ValueError where there is none, or the scene or it cannot be read.
    """
    folder = Path(run)
    require_loadable(folder, unfinished=unfinished)
    if prepared is None:
        config = read_config(folder)
        check_plugins(folder, config.get("plugins", []), ())
        prepared = prepare(config)
    settings, scene = prepared.of_field()
    trained = Trained(folder, settings, scene, build_model(settings, scene).eval(), 0)
    return trained.reloaded()
