"""Training with `numerics.finite_checks=true`, and the file from which `qnerf replay` repeats a failed step."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from qnerf.config.settings import Settings
from qnerf.geometry.pose_refinement import PoseRefinement
from qnerf.geometry.rays import RayTable
from qnerf.model.model import Model
from qnerf.records.checkpoints import load_archive
from qnerf.records.files import replace
from qnerf.rendering.samplers import SampledRays
from qnerf.timing import Stopwatch
from qnerf.training.finite_checks import FiniteChecks, NonFinite, check_finite
from qnerf.training.trainer import Trainer
from qnerf.types import Rays, Rendering

FILE = "nonfinite.pt"
"""In the run's folder: everything needed to repeat the step."""
CONTENT = {"told": str, "part": str, "values": Tensor, "config": dict, "state": dict, "rays": dict, "colors": Tensor}
"""Keys of the file and their types: `told` is the message, `part` names the tensor."""
BACKWARD = ("color", "appearance", "density", "encoder", "sampler", "cameras")
"""Parts of the model in the order in which the gradient of the loss reaches them."""
RAY_FIELDS = [field.name for field in fields(Rays)]


class RecordingTable(RayTable):
    """A copy of a table that remembers its last batch."""

    last: tuple[Rays, Tensor] | None = None

    def __init__(self, table: RayTable) -> None:
        vars(self).update(vars(table))

    def rays(self, views: Tensor, pixels: Tensor, refinement: PoseRefinement | None = None) -> Rays:
        self.last_pixels = pixels  # (R,) row-major numbers
        return super().rays(views, pixels, refinement)

    def batch(
        self, rays: int, generator: torch.Generator, refinement: PoseRefinement | None = None
    ) -> tuple[Rays, Tensor]:
        self.last = batch = super().batch(rays, generator, refinement)
        return batch


class ReplayTable(RecordingTable):
    """Returns a stored batch, even if the scene has changed. Gradients flow to rays that are still the same."""

    def __init__(self, table: RayTable, rays: dict[str, Tensor], colors: Tensor) -> None:
        super().__init__(table)
        self.stored = {name: rays[name].to(table.device) for name in RAY_FIELDS}, colors.to(table.device)

    def batch(
        self, rays: int, generator: torch.Generator, refinement: PoseRefinement | None = None
    ) -> tuple[Rays, Tensor]:
        now, drawn = super().batch(rays, generator, refinement)
        then, colors = self.stored
        for name, old in {**then, "colors": colors}.items():
            expected = drawn if name == "colors" else getattr(now, name)
            if old.shape != expected.shape or old.dtype != expected.dtype:
                raise ValueError(
                    f"the stored {name} of the rays: expected {tuple(expected.shape)} of {expected.dtype}, "
                    f"got {tuple(old.shape)} of {old.dtype}"
                )
        merged = {name: torch.where(getattr(now, name) == old, getattr(now, name), old) for name, old in then.items()}
        self.last = Rays(**merged), colors
        return self.last


@dataclass(frozen=True)
class RunContext:
    """What the message and the file say about the run."""

    view_names: Sequence[str]
    config: Mapping[str, Any]
    file: Path | None  # to write the step to; None: it is not stored


class CheckedTrainer(Trainer):
    """A trainer that stops at the first value that is not finite, and stores the step so that it can be repeated."""

    table: RecordingTable

    def __init__(
        self, model: Model, table: RayTable, settings: Settings, watch: Stopwatch, context: RunContext
    ) -> None:
        recording = table if isinstance(table, RecordingTable) else RecordingTable(table)
        super().__init__(model, recording, settings, watch)
        self.checks = FiniteChecks(model)
        self.context = context
        self.optimiser.register_step_pre_hook(lambda *_: self._check_gradients())
        self.optimiser.register_step_post_hook(lambda *_: self._check_parameters())

    def take_step(self, measure: bool) -> dict[str, float]:
        """Like `Trainer.take_step`.

        Raises:
            NonFinite: names the tensor and the step, and if there is one the ray, its view and its pixel.
        """
        before = copy.deepcopy(self.state())
        self.table.last = None
        try:
            with self.checks:
                return super().take_step(measure)
        except NonFinite as error:
            self._report(error, before)
            raise error from None

    def loss_terms(self, rendering: Rendering, sampled: SampledRays, target: Tensor) -> dict[str, Tensor]:
        check_finite("target colours", target, int)
        terms = super().loss_terms(rendering, sampled, target)
        for name, term in terms.items():
            check_finite(f"loss term {name}", term)
        return terms

    def _check_gradients(self) -> None:
        parts = self.model.parts
        names = {parameter: name for name, parameter in self.model.named_parameters()}
        for part in BACKWARD:
            for parameter in parts.get(part, []):
                if parameter.grad is not None:
                    check_finite(f"gradient of {names[parameter]}", parameter.grad)

    def _check_parameters(self) -> None:
        for name, parameter in self.model.named_parameters():
            check_finite(f"parameters after the step, {name}", parameter)

    def _report(self, error: NonFinite, before: dict[str, Any]) -> None:
        """Completes the message and writes the file; `before` is the trainer's state before the step."""
        message = f"{error.message}; step {before['step']}"
        if self.table.last is None:  # the occupancy update failed, before the batch was drawn: any batch will do
            self.table.batch(self.train.rays, self.streams["pixels"], self.model.cameras)
        assert self.table.last is not None
        rays, colors = self.table.last
        if error.ray is not None:
            view = int(rays.cameras[error.ray])
            y, x = divmod(int(self.table.last_pixels[error.ray]), self.table.cameras.size(view)[0])
            name = self.context.view_names[view]
            message += f", ray {error.ray} of the batch, camera {name}, pixel x={x} y={y}"
        error.message, error.args = message, (message,)
        file = self.context.file
        if file is not None:
            content = {
                "told": message,
                "part": error.where,
                "values": error.values.clone(),
                "config": dict(self.context.config),
                "state": before,
                "rays": {name: getattr(rays, name).detach().clone() for name in RAY_FIELDS},
                "colors": colors,
            }
            replace(file, lambda sink: torch.save(content, sink))
            error.args = (f"{message}; `qnerf replay {file}` repeats the step",)


def load_step(file: Path) -> dict[str, Any]:
    """Reads what `CheckedTrainer` wrote. Nothing in the file is executed.

    Raises:
        ValueError: the file is something else.
    """
    try:
        content = load_archive(file)
    except OSError:
        raise
    except Exception as error:  # readers of a damaged or foreign file raise many kinds of errors
        raise ValueError(f"{file}: expected a {FILE} of numerics.finite_checks, got {type(error).__name__}") from error
    if not isinstance(content, dict) or {k: type(v) for k, v in content.items()} != CONTENT:
        raise ValueError(f"{file}: expected a {FILE} of numerics.finite_checks, got other content")
    stored = content["rays"]
    missing = [name for name in RAY_FIELDS if not isinstance(stored.get(name), Tensor)]
    if missing:
        raise ValueError(f"{file}: expected the rays of the step, {missing[0]} is missing")
    return content
