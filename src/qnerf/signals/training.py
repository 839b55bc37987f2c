"""Training and evaluation of one head on a signal."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from qnerf.config.settings import Fit, SignalSettings
from qnerf.config.tensors import require_tensor
from qnerf.geometry.rays import sent
from qnerf.metrics import quality_metrics
from qnerf.signals.model import SignalModel
from qnerf.timing import Stopwatch
from qnerf.training.evaluation import beside
from qnerf.training.stopping import Plateau
from qnerf.training.trainer import Loop

CHUNK = 4096  # points evaluated at once


class Fitted(Protocol):
    """A trained model in evaluation mode, as a function of points (N, D) in the unit cube. Results are float64."""

    def values(self, points: Tensor) -> Tensor:
        """(N, C)"""

    def gradients(self, points: Tensor) -> Tensor:
        """(N, D): of the first value, by the coordinates."""


class Learnt(Protocol):
    """What training and evaluation ask of a `qnerf.signals.base.Signal`."""

    name: str
    headline: str
    points: Tensor
    targets: Tensor

    def terms(self, predicted: Tensor, targets: Tensor) -> dict[str, Tensor]: ...

    def evaluate(self, fitted: Fitted) -> tuple[dict[str, float | None], list[Tensor]]: ...


class SignalTrainer(Loop):
    """Trains on batches of the signal's points: on all of them in every step where there are no more than a batch."""

    model: SignalModel
    train: Fit

    def __init__(self, model: SignalModel, signal: Learnt, settings: SignalSettings, watch: Stopwatch) -> None:
        self.points_a_step = self.rays_a_step = min(settings.train.points, len(signal.points))
        super().__init__(model, settings, watch, Plateau(every=0, patience=1, min_gain_db=0.0))
        self.signal = signal
        self.points, self.targets = (
            values.to(settings.torch_device, settings.dtype) for values in (signal.points, signal.targets)
        )

    def draw(self) -> list[Tensor]:
        """Numbers of training points; none where all are taken."""
        if len(self.points) <= self.train.points:
            return []
        index = torch.randint(len(self.points), (self.train.points,), generator=self.streams["pixels"])
        return [sent(index, self.points.device)]

    def terms(self, drawn: list[Tensor]) -> dict[str, Tensor]:
        self.computing = "the model"
        with self.watch.stage("sampling"):
            points, targets = self.points, self.targets
            if drawn:
                points, targets = points[drawn[0]], targets[drawn[0]]
        with self.watch.stage("field"):
            predicted = self.model(points)
        self.computing = "the loss"
        with self.watch.stage("render"):
            return self.signal.terms(predicted, targets)


@dataclass(frozen=True)
class FittedView:
    """What an evaluation drew: panels (H, W, 3) in [0, 1]."""

    view: int
    panels: list[Tensor]


class SignalEvaluator:
    """Measures and draws a fit, deterministically and without touching any random state. See `Fitted`."""

    def __init__(self, model: SignalModel, signal: Learnt, settings: SignalSettings, watch: Stopwatch) -> None:
        self.model = model
        self.scene = signal
        self.device, self.dtype = settings.torch_device, settings.dtype
        self.watch = watch

    @torch.no_grad()
    def values(self, points: Tensor) -> Tensor:
        parts = [self.model(part.to(self.device, self.dtype)) for part in points.split(CHUNK)]
        return torch.cat(parts).double().cpu()

    def gradients(self, points: Tensor) -> Tensor:
        parts = []
        for part in points.split(CHUNK):
            leaf = part.to(self.device, self.dtype).requires_grad_()
            (gradient,) = torch.autograd.grad(self.model(leaf)[:, 0].sum(), leaf)
            parts.append(gradient.double().cpu())
        return torch.cat(parts)

    def views(
        self, views: list[int], step: int, rays: int | None = None
    ) -> Iterator[tuple[FittedView, dict[str, float | str | None]]]:
        """The one view of a signal, with its name under `image` and its metrics. It is measured as a whole."""
        training = self.model.training
        self.model.eval()
        self.watch.begin(measure=False)
        measured, panels = self.scene.evaluate(self)
        if not panels:
            raise ValueError(
                f"{type(self.scene).__name__}: `evaluate` returned no panels; expected one or more (H, W, 3)"
            )
        for panel in panels:
            require_tensor(f"{type(self.scene).__name__}: a panel", panel, (panels[0].shape[0], "W", 3))
        declared = [metric.key for metric in quality_metrics()]
        for key in (*measured, self.scene.headline):
            if key not in measured or key not in declared:
                raise ValueError(
                    f"{type(self.scene).__name__}: metric {key!r} must be one that `evaluate` returns and "
                    f"`qnerf.metrics.declare` knows; returned: {', '.join(measured)}; known: {', '.join(declared)}"
                )
        self.model.train(training)
        yield FittedView(0, panels), {"image": self.scene.name, **measured}

    def preview(self, step: int) -> np.ndarray:
        ((view, _),) = self.views([0], step)
        return self.picture(view)

    def picture(self, view: FittedView) -> np.ndarray:
        """truth | fit | error as one image (h, w, 3) uint8."""
        return beside(view.panels)
