"""How fine the hash grid has to be: the finest detail in the images, in cells per world unit."""

import numpy as np
import torch
from numpy.typing import NDArray

from qnerf.auto.views import grey, subset
from qnerf.geometry.bounds import focus
from qnerf.geometry.contraction import Contraction
from qnerf.scenes import Scene

WORTH = 1e-4  # mean squared error at 40 dB; the highest frequencies that together have less power are ignored
VIEWS = 40  # most views to measure


def finest_frequency(scene: Scene) -> float:
    """Cycles per pixel, at most 1/2, above which the training images have less power than `WORTH`.

    The power spectrum is the mean over images under a Hann window, corrected for the power that the window removes.
    """
    views = subset(scene.train, VIEWS)
    powers: dict[tuple[int, int], NDArray[np.float64]] = {}  # of views of one size (H, W), summed
    for view in views:
        image = grey(scene, view)
        image = np.nan_to_num(image, nan=1.0 if scene.mask is None else float(np.nan_to_num(np.nanmean(image))))
        height, width = image.shape
        window = np.outer(np.hanning(height + 2)[1:-1], np.hanning(width + 2)[1:-1])
        flat = (image - np.average(image, weights=window)) * window
        power = np.abs(np.fft.fft2(flat)) ** 2 / (window**2).sum() / (height * width) / len(views)
        powers[height, width] = powers.get((height, width), 0.0) + power
    radii = [np.hypot(np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width)[None, :]) for height, width in powers]
    return above(*(np.concatenate([part.ravel() for part in parts]) for parts in (radii, powers.values())))


def above(radius: NDArray[np.float64], power: NDArray[np.float64]) -> float:
    """The smallest radius beyond which the power adds up to no more than `WORTH`; at most 1/2."""
    order = np.argsort(-radius)
    beyond = np.cumsum(power[order])
    within = int(np.searchsorted(beyond, WORTH))
    return 0.0 if within == len(order) else min(0.5, float(radius[order][within]))


def focus_point(scene: Scene) -> NDArray[np.float64] | None:
    """The point (3,), in world units, that the training cameras look at; None if there is none."""
    return focus(scene.cameras.poses.numpy()[scene.train])


def focus_distance(scene: Scene) -> float:
    """Median distance, in world units, from the training cameras to the point that they look at; 1 if there is none."""
    poses = scene.cameras.poses.numpy()[scene.train]
    point = focus_point(scene)
    return 1.0 if point is None else float(np.median(-((point - poses[:, :, 3]) * poses[:, :, 2]).sum(-1)))


def cells_per_world_unit(scene: Scene) -> float:
    """Two cells per period of the finest frequency, at the distance that the cameras focus on."""
    focal = float(scene.cameras.fx[scene.train].median())
    return 2 * finest_frequency(scene) * focal / focus_distance(scene)


def world_units_along_the_cube(contraction: Contraction, point: NDArray[np.float64] | None) -> float:
    """Length in the world that the side of the unit cube would have at a point (3,): 4 in the middle of a contraction.

    It grows with the distance from the middle, because a contraction squeezes what is far away. The direction that is
    squeezed least counts. point: in world units; None: the middle.
    """
    at = torch.zeros(3, dtype=torch.float64) if point is None else torch.as_tensor(point, dtype=torch.float64)
    jacobian = torch.autograd.functional.jacobian(contraction, at)
    return 1 / float(torch.linalg.matrix_norm(jacobian, ord=2))
