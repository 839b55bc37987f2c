"""Pairs of training views that show the same things, and their grey images."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from qnerf.scenes import Scene

T = TypeVar("T")

ANGLE = np.deg2rad(30)  # views whose optical axes differ by more are not compared


def neighbours(scene: Scene) -> list[tuple[int, int]]:
    """Each training view with the nearest one that looks the same way, within 30 degrees.

    No pair appears twice; views without such a neighbour are left out.
    """
    views = np.array(scene.train)
    poses = scene.cameras.poses.numpy()[views]
    centres, axes = poses[:, :, 3], -poses[:, :, 2]
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    turned = np.arccos(np.clip(axes @ axes.T, -1, 1)) > ANGLE
    apart[turned | np.eye(len(views), dtype=bool)] = np.inf
    nearest = apart.argmin(axis=1)
    pairs = {
        (min(a, b), max(a, b)) for a, b in zip(range(len(views)), nearest.tolist(), strict=True) if apart[a, b] < np.inf
    }
    return [(int(views[a]), int(views[b])) for a, b in sorted(pairs)]


def grey(scene: Scene, view: int) -> NDArray[np.float64]:
    """The view (H, W) in [0, 1], its three channels averaged; NaN where it is transparent or masked."""
    pixels = scene.image(view).numpy().astype(np.float64) / 255
    mean: NDArray[np.float64] = pixels[..., :3].mean(-1)
    if pixels.shape[-1] == 4:
        mean[pixels[..., 3] <= 0.5] = np.nan
    if (valid := scene.valid(view)) is not None:
        mean[~valid.numpy()] = np.nan
    return mean


def subset(items: list[T], limit: int) -> list[T]:
    """At most `limit` of the items, evenly spread."""
    if len(items) <= limit:
        return items
    return [items[int(index)] for index in np.linspace(0, len(items) - 1, limit)]
