"""`Signal`: a function of coordinates, given by its values at points."""

from collections.abc import Sequence
from typing import Any, Protocol

import torch
from torch import Tensor

from qnerf.config.tensors import require_tensor
from qnerf.scenes import SCENES

FLOATS = (torch.float64, torch.float32)


class Fitted(Protocol):
    """A trained model in evaluation mode, as a function of points (N, D) in the unit cube. Results are float64."""

    def values(self, points: Tensor) -> Tensor:
        """(N, C)"""

    def gradients(self, points: Tensor) -> Tensor:
        """(N, D): of the first value, by the coordinates."""


class Signal:
    """What one head learns by itself: values at points of the unit cube, a loss, and how a fit is measured.

    A subclass is registered in `SCENES`. Its keyword-only parameters are the user's options of the group `scene`.
    """

    name: str
    fingerprint: str
    """Hash of what the signal is made from; the same on every machine."""
    points: Tensor  # (N, D) float64: the training points, coordinates in [0, 1]
    targets: Tensor  # (N, C) float64: the values there
    headline: str
    """Key of the metric that is shown during training."""

    eval: Sequence[int] = (0,)  # the whole signal is one view

    @property
    def names(self) -> list[str]:
        return [self.name]

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


def is_signal(node: Any) -> bool:
    """Whether the group `scene` names a signal, not posed images; ValueError for an unknown name."""
    scene = SCENES.get(node["name"])
    return isinstance(scene, type) and issubclass(scene, Signal)
