"""`Signal`: a function of coordinates, given by its values at points."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from qnerf.config.settings import SignalSettings
from qnerf.config.tensors import require_tensor
from qnerf.signals.model import SignalModel, build_signal_model
from qnerf.signals.training import Fitted, SignalEvaluator, SignalTrainer
from qnerf.timing import Stopwatch
from qnerf.training.evaluation import colormap
from qnerf.training.task import Task

FLOATS = (torch.float64, torch.float32)


class Signal(Task):
    """What one head learns by itself: values at points of the unit cube, a loss, and how a fit is measured.

    A subclass is registered in `SCENES`. Its keyword-only parameters are the user's options of the group `scene`.
    """

    options = SignalSettings
    base = "_signal"
    held_out = ""
    settings: SignalSettings
    model: SignalModel

    points: Tensor  # (N, D) float64: the training points, coordinates in [0, 1]
    targets: Tensor  # (N, C) float64: the values there

    eval: Sequence[int] = (0,)  # the whole signal is one view

    @property
    def names(self) -> list[str]:  # type: ignore[override]
        return [self.name]

    def build(self, settings: SignalSettings) -> None:
        self.settings = settings
        self.model = build_signal_model(settings, self.points.shape[-1], self.targets.shape[-1])
        colormap()  # a file that cannot be used is reported now

    @property
    def points_a_step(self) -> int:
        return min(self.settings.train.points, len(self.points))

    def trainer(self, watch: Stopwatch) -> SignalTrainer:
        return SignalTrainer(self.model, self, self.settings, watch)

    def evaluator(self, watch: Stopwatch) -> SignalEvaluator:
        return SignalEvaluator(self.model, self, self.settings, watch)

    def check(self) -> None:
        """ValueError unless points and targets have the shapes above, are finite, and the points lie in the cube."""
        name = type(self).__name__
        require_tensor(f"{name}.points", self.points, ("N", "D"), *FLOATS)
        require_tensor(f"{name}.targets", self.targets, (len(self.points), "C"), *FLOATS)
        for what, values in (("points", self.points), ("targets", self.targets)):
            finite = int(values.isfinite().sum())
            if finite < max(1, values.numel()):
                raise ValueError(f"{name}.{what}: expected finite numbers, got {finite} of {values.numel()}")
        if not bool(((self.points >= 0) & (self.points <= 1)).all()):
            low, high = self.points.min(), self.points.max()
            raise ValueError(f"{name}.points: expected coordinates in [0, 1], got {low:.4g} to {high:.4g}")

    def decide(self, configuration: Any) -> tuple[Any, Mapping[str, Any]]:
        self.check()
        return super().decide(configuration)

    def description(self) -> str:
        """One line: how much there is to train on."""
        count, dims = self.points.shape
        return f"{count:,} training points of {dims} coordinates, {self.targets.shape[-1]} values each"

    def terms(self, predicted: Tensor, targets: Tensor) -> dict[str, Tensor]:
        """The terms of the loss of predicted values (B, C), under the names that metrics.parquet gives them."""
        raise NotImplementedError

    def evaluate(self, fitted: Fitted) -> tuple[dict[str, float | None], list[Tensor]]:
        """Metric -> value, and the panels of the picture: truth, fit and error, each (H, W, 3) in [0, 1]."""
        raise NotImplementedError
