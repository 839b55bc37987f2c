"""The distance of a shape's surface as a function of points."""

import copy
import math
from typing import Literal

import torch
from torch import Tensor

from qnerf.config.bounds import PositiveInt, Seed
from qnerf.scenes import SCENES
from qnerf.scenes.base import digest, hold_out
from qnerf.signals.base import Fitted, Signal
from qnerf.signals.lattice import grid
from qnerf.signals.shapes import SHAPES
from qnerf.training.evaluation import ERROR_GAIN, colormap
from qnerf.training.image_metrics import octave_errors

VERSION = "1"  # raise it whenever the shapes change
EVALUATED = {2: 128, 3: 32}  # points along each axis of the grid on which a fit is measured
PICTURE = 128  # points along each axis of the picture, which shows the middle plane z = 0.5 of a solid
FURTHEST = 0.3  # distance with the full colour in the picture


@SCENES.register("distance")
class Distance(Signal):
    """The signed distance of a shape: negative inside, in sides of the unit cube. Distances are exact.

    Training sees points that are drawn uniformly from the cube. A fit is measured on a regular grid of other points.

    Args:
        shape: `horse`, the outline of scikit-image's silhouette in the unit square; `ellipsoid`, in the unit cube.
        samples: training points.
        seed: of the training points.
    """

    headline = "distance_error"

    def __init__(
        self, *, shape: Literal["horse", "ellipsoid"] = "horse", samples: PositiveInt = 16384, seed: Seed = 0
    ) -> None:
        self.name = shape
        self.fingerprint = digest("distance", VERSION)
        dims, self.exact = SHAPES[shape]
        random = torch.Generator().manual_seed(seed)
        self.points = torch.rand(samples, dims, dtype=torch.float64, generator=random)
        self.targets = self.distances(self.points)
        self.lattice = (EVALUATED[dims],) * dims
        self.unseen = grid(self.lattice)
        self.plane = grid([PICTURE] * 2)
        if dims == 3:
            self.plane = torch.nn.functional.pad(self.plane, (0, 1), value=0.5)

    def validating(self, share: float) -> "Distance":
        """Measured on some of the training points."""
        found = copy.copy(self)
        kept, chosen = hold_out(range(len(self.points)), share)
        found.points, found.targets, found.unseen = self.points[kept], self.targets[kept], self.points[chosen]
        return found

    def distances(self, points: Tensor) -> Tensor:
        """Points (N, D) -> true distances (N, 1)."""
        return torch.from_numpy(self.exact(points.numpy()))[:, None]

    def terms(self, predicted: Tensor, targets: Tensor) -> dict[str, Tensor]:
        return {"distance_error": torch.nn.functional.l1_loss(predicted, targets)}

    def evaluate(self, fitted: Fitted) -> tuple[dict[str, float | None], list[Tensor]]:
        """Mean absolute error, IoU of the inside, how far the gradient's length is from 1, and the error in octaves.

        On unseen points; the octaves only where these are the lattice.
        """
        distance, truth = fitted.values(self.unseen), self.distances(self.unseen)
        inside, truly = distance < 0, truth < 0
        lengths = torch.linalg.vector_norm(fitted.gradients(self.unseen), dim=-1)
        measured: dict[str, float | None] = {
            "distance_error": float((distance - truth).abs().mean()),
            "iou": float((inside & truly).sum() / (inside | truly).sum()),
            "eikonal_error": float((lengths - 1).abs().mean()),
        }
        if len(self.unseen) == math.prod(self.lattice):
            measured |= octave_errors(*(values.view(*self.lattice, 1) for values in (distance, truth)))
        shown = [values.view(PICTURE, PICTURE) for values in (self.distances(self.plane), fitted.values(self.plane))]
        error = (ERROR_GAIN * (shown[1] - shown[0]).abs() / FURTHEST).clamp(0, 1)
        return measured, [*map(shade, shown), error[..., None].expand(-1, -1, 3)]


def shade(distance: Tensor) -> Tensor:
    """Distances (H, W) -> (H, W, 3) in [0, 1]: dark outside, bright inside, in steps; the surface is white."""
    steps = (distance / FURTHEST).clamp(-1, 1).mul(10).floor() / 10
    colors = torch.from_numpy(colormap()((0.45 - 0.45 * steps).numpy())[..., :3])
    inside = (distance < 0).to(torch.float64)
    edge = torch.nn.functional.max_pool2d(inside[None], 3, 1, 1)[0] != inside
    return torch.where(edge[..., None], 1.0, colors)
