"""`numerics.finite_checks=true`: stops at the first value of a training step that is not finite, and names its part.

Hooks are in place during a training step only, and only with this option. What a part puts out is looked at before the
next part sees it, in the order of the flow: rays, samples, encoder, heads and their circuits, weights, rendering, loss
terms, gradients, parameters. A density may be infinite: rendering is defined for it.
"""

import copy
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from qnerf.config.settings import Settings
from qnerf.geometry.pose_refinement import PoseRefinement
from qnerf.geometry.rays import RayTable
from qnerf.model.model import Model
from qnerf.quantum import QuantumLayer
from qnerf.records.checkpoints import load_archive
from qnerf.records.files import replace
from qnerf.rendering.samplers import SampledRays
from qnerf.rendering.shading import Shaded
from qnerf.timing import Stopwatch
from qnerf.training.trainer import Diverged, Trainer
from qnerf.types import Rays, Rendering

FILE = "nonfinite.pt"
"""In the run's folder: everything to repeat the step."""
CONTENT = {"told": str, "part": str, "values": Tensor, "config": dict, "state": dict, "rays": dict, "colors": Tensor}
BACKWARD = ("color", "appearance", "density", "encoder", "sampler", "cameras")
"""Parts in the order in which the loss's gradient reaches them."""

RayOf = Callable[[int], int | None]
"""Row of a tensor -> number of the ray in its batch that it belongs to; None where it belongs to none."""


class NonFinite(Diverged):
    """A value is not finite. `values` are those of the `part` it is in; `ray` is None where that is no one ray."""

    def __init__(self, part: str, values: Tensor, ray_of: RayOf | None) -> None:
        self.part, self.values = part, values.detach()
        wrong = ~torch.isfinite(self.values)
        index = tuple(wrong.nonzero()[0].tolist())
        many = f": {int(wrong.sum())} of {wrong.numel()} values, first [{', '.join(map(str, index))}]" if index else ""
        self.told = f"{float(self.values[index])} in {part}{many}"
        self.ray: int | None = None
        if ray_of is not None and (len(wrong) == 1 or not bool(wrong.reshape(len(wrong), -1).any(1).all())):
            self.ray = ray_of(index[0])  # else every ray has it
        super().__init__(self.told)


class Checks:
    """While entered, looks at what flows through a model; raises `NonFinite`."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self._hooks = ExitStack()
        self._unit: Tensor | None = None  # (R, K, 3) samples of the step in the unit cube

    def __enter__(self) -> None:
        model, field = self.model, self.model.field
        self._hook(model, self._rays, self._rendering)
        self._hook(model.sampler, None, self._samples)
        self._hook(field.contraction, None, self._points)
        self._hook(field.encoder, None, self._encoded)
        self._hook(model.shading, self._weights, self._chosen)
        self._head("density head", field.density_head, self._ray_of_point)
        self._head("colour head", field.color_head, self._ray_of_color)

    def __exit__(self, *_: object) -> None:
        self._hooks.close()
        self._unit = None

    def _hook(self, module: nn.Module, before: Callable[..., None] | None, after: Callable[..., None]) -> None:
        if before is not None:
            self._hooks.callback(module.register_forward_pre_hook(lambda _, given: before(*given)).remove)
        self._hooks.callback(module.register_forward_hook(lambda _, given, out: after(out, *given)).remove)

    def _head(self, name: str, head: nn.Module, ray_of: RayOf) -> None:
        circuits = [module for module in head.modules() if isinstance(module, QuantumLayer)]
        parts = [(name, head), *((f"circuit {number} of the {name}", c) for number, c in enumerate(circuits))]
        for part, module in parts:

            def before(given: Tensor, part: str = part) -> None:
                look(f"inputs of {part}", given, ray_of)

            def after(out: Tensor, _: Tensor, part: str = part) -> None:
                look(part, out, ray_of)

            self._hook(module, before, after)

    def _rays(self, rays: Rays) -> None:
        for name in ("origins", "directions", "near", "far"):
            look(f"rays ({name})", getattr(rays, name), int)

    def _samples(self, sampled: SampledRays, *_: object) -> None:
        for number, (intervals, weights) in enumerate(sampled.proposals):
            look(f"samples of proposal network {number}", intervals.edges, int)
            look(f"weights of proposal network {number}", weights, int)
        look("samples", sampled.samples.edges, int)
        look("samples (normalised)", sampled.samples.spacing, int)

    def _points(self, unit: Tensor, _: Tensor) -> None:
        look("contracted points", unit, int)
        self._unit = unit

    def _encoded(self, features: Tensor, points: Tensor) -> None:
        self._at = points
        look("encoder", features, self._ray_of_point)

    def _weights(self, shares: Tensor, *_: object) -> None:
        look("shares", shares, int)

    def _chosen(self, shaded: Shaded, *_: object) -> None:
        look("shading (shares)", shaded.shares, int)
        look("shading (geometry)", shaded.geometry, int)
        self._kept = torch.ones_like(shaded.shares, dtype=torch.bool) if shaded.mask is None else shaded.mask

    def _rendering(self, out: tuple[Rendering, SampledRays, Tensor | None], _: Rays) -> None:
        for name in ("color", "depth", "accumulation"):
            look(f"rendering ({name})", getattr(out[0], name), int)

    def _ray_of_point(self, row: int) -> int | None:
        """The field may leave points out: the one that the encoder got is looked up among all.

        None while the occupancy is looked at, which comes before the rays.
        """
        if self._unit is None:
            return None
        return int((self._unit == self._at[row]).all(-1).nonzero()[0, 0])

    def _ray_of_color(self, row: int) -> int:
        return int(self._kept.nonzero()[row, 0])


def look(part: str, values: Tensor, ray_of: RayOf | None = None) -> None:
    """Raises `NonFinite` unless all values are finite."""
    if not bool(torch.isfinite(values.detach()).all()):
        raise NonFinite(part, values, ray_of)


class Recorder(RayTable):
    """The table it is made of; it remembers the batch that it gave last."""

    last: tuple[Rays, Tensor] | None = None

    def __init__(self, table: RayTable) -> None:
        vars(self).update(vars(table))

    def rays(self, views: Tensor, pixels: Tensor, refinement: PoseRefinement | None = None) -> Rays:
        self.drawn = pixels  # (R,) row-major numbers
        return super().rays(views, pixels, refinement)

    def batch(
        self, rays: int, generator: torch.Generator, refinement: PoseRefinement | None = None
    ) -> tuple[Rays, Tensor]:
        self.last = batch = super().batch(rays, generator, refinement)
        return batch


class Recorded(Recorder):
    """Gives a batch as it was, whatever the scene is now; gradients go where it still is the same."""

    def __init__(self, table: RayTable, rays: dict[str, Tensor], colors: Tensor) -> None:
        super().__init__(table)
        self.before = {name: rays[name].to(table.device) for name in _FIELDS}, colors.to(table.device)

    def batch(
        self, rays: int, generator: torch.Generator, refinement: PoseRefinement | None = None
    ) -> tuple[Rays, Tensor]:
        now, _ = super().batch(rays, generator, refinement)
        then, colors = self.before
        same = {name: torch.where(getattr(now, name) == then[name], getattr(now, name), then[name]) for name in _FIELDS}
        self.last = Rays(**same), colors
        return self.last


_FIELDS = [field.name for field in fields(Rays)]


@dataclass(frozen=True)
class Origin:
    """What a message and a file say beside the numbers: names of the views, configuration, where the file goes."""

    names: Sequence[str]
    config: Mapping[str, Any]
    file: Path | None  # None: nowhere


class CheckedTrainer(Trainer):
    """A trainer that stops at the first value of a step that is not finite, and keeps the step in a file."""

    table: Recorder

    def __init__(self, model: Model, table: RayTable, settings: Settings, watch: Stopwatch, origin: Origin) -> None:
        recorder = table if isinstance(table, Recorder) else Recorder(table)
        super().__init__(model, recorder, settings, watch)
        self.checks = Checks(model)
        self.origin = origin
        self.optimiser.register_step_pre_hook(lambda *_: self._look_at_gradients())
        self.optimiser.register_step_post_hook(lambda *_: self._look_at_parameters())

    def take_step(self, measure: bool) -> dict[str, float]:
        """As `Trainer.take_step`.

        Raises:
            NonFinite: names the part, the step, and where there is one the ray, its camera and its pixel.
        """
        before = copy.deepcopy(self.state())
        self.table.last = None
        try:
            with self.checks:
                return super().take_step(measure)
        except NonFinite as found:
            raise self._kept(found, before) from None

    def loss_terms(self, rendering: Rendering, sampled: SampledRays, target: Tensor) -> dict[str, Tensor]:
        look("target colours", target, int)
        terms = super().loss_terms(rendering, sampled, target)
        for name, term in terms.items():
            look(f"loss term {name}", term)
        return terms

    def _look_at_gradients(self) -> None:
        parts = self.model.parts
        names = {parameter: name for name, parameter in self.model.named_parameters()}
        for part in BACKWARD:
            for parameter in parts.get(part, []):
                if parameter.grad is not None:
                    look(f"gradient of {names[parameter]}", parameter.grad)

    def _look_at_parameters(self) -> None:
        for name, parameter in self.model.named_parameters():
            look(f"parameters after the step, {name}", parameter)

    def _kept(self, found: NonFinite, before: dict[str, Any]) -> NonFinite:
        """`found` with all that is to be told; the file is written."""
        told = f"{found.told}; step {before['step']}"
        if self.table.last is None:  # the occupancy was looked at, which comes first: any batch will do
            self.table.batch(self.train.rays, self.streams["pixels"], self.model.cameras)
        assert self.table.last is not None
        rays, colors = self.table.last
        if found.ray is not None:
            y, x = divmod(int(self.table.drawn[found.ray]), self.table.width)
            camera = self.origin.names[int(rays.cameras[found.ray])]
            told += f", ray {found.ray} of the batch, camera {camera}, pixel x={x} y={y}"
        file = self.origin.file
        if file is not None:
            content = {
                "told": told,
                "part": found.part,
                "values": found.values.clone(),
                "config": dict(self.origin.config),
                "state": before,
                "rays": {name: getattr(rays, name).detach().clone() for name in _FIELDS},
                "colors": colors,
            }
            replace(file, lambda sink: torch.save(content, sink))
        found.told = told
        found.args = (told if file is None else f"{told}; `qnerf replay {file}` repeats the step",)
        return found


def load(file: Path) -> dict[str, Any]:
    """What `CheckedTrainer` wrote. ValueError where the file is something else; nothing in it is run."""
    try:
        content = load_archive(file)
    except OSError:
        raise
    except Exception as error:  # whatever a file that is something else makes its readers raise
        raise ValueError(f"{file}: expected a {FILE} of numerics.finite_checks, got {type(error).__name__}") from error
    if not isinstance(content, dict) or {k: type(v) for k, v in content.items()} != CONTENT:
        raise ValueError(f"{file}: expected a {FILE} of numerics.finite_checks, got other content")
    return content
