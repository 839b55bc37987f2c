"""How close a rendered view (H, W, 3) is to the true one. Colours are in [0, 1]; everything is computed in float64.

A metric is a `Metric` in `qnerf.metrics` and, under the same key, a function of a `Comparison` here. Every evaluation
then measures it, and tables, figures, the report and the command line show it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.fft import dctn
from scipy.ndimage import binary_erosion
from skimage.metrics import structural_similarity
from torch import Tensor

from qnerf.config.registry import Registry
from qnerf.metrics import OCTAVES, image_metrics
from qnerf.training.lpips import lpips

__all__ = [
    "IMAGE_METRICS",
    "Comparison",
    "depth_error",
    "explained",
    "lpips",
    "measure",
    "octave_energies",
    "octave_errors",
    "octaves_of",
    "psnr",
    "ssim",
]

Measured = float | None | tuple[float | None, str | None]
"""A metric's value, None where it cannot be had; or the value and why there is none."""

IMAGE_METRICS: Registry[Measured] = Registry("image metric")
"""Key of the metric -> function of a `Comparison`."""


@dataclass(frozen=True)
class Comparison:
    """A rendered view beside the true one."""

    color: Tensor  # (H, W, 3) in [0, 1], float64
    truth: Tensor  # (H, W, 3) in [0, 1], float64
    depth: Tensor  # (H, W), world units
    true_depth: Tensor | None  # (H, W), world units; None where the scene has no depth
    mask: Tensor | None = None  # (H, W) bool: False is not counted; None: everything is
    solid: Tensor | None = None  # (H, W) bool: where the true view shows something; None: everywhere
    stride: int = 1  # of the view's rows and columns that are here
    specular: Tensor | None = None  # (H, W) uint8, see `Scene`; None where the scene does not know it

    @cached_property
    def octaves(self) -> dict[str, float | None]:
        """`octave_errors`; nothing where rows, columns or pixels are missing."""
        whole = self.stride == 1 and (self.mask is None or bool(self.mask.all()))
        return octave_errors(self.color, self.truth) if whole else {}


def measure(view: Comparison) -> dict[str, float | str | None]:
    """Every image metric of the view under its key, and `<key>_reason` for metrics that say why they have no value."""
    row: dict[str, float | str | None] = {}
    for metric in image_metrics():
        measured = IMAGE_METRICS.get(metric.key)(view)
        row[metric.key], *reason = measured if isinstance(measured, tuple) else (measured,)
        row |= {f"{metric.key}_reason": text for text in reason}
    return row


VIEW_DEPENDENT = 13  # levels of specular light, a twentieth of full brightness, from which on a pixel is one of these
_RADIUS = 5  # pixels: a window of 11 x 11


def _check(image: Tensor, truth: Tensor) -> None:
    if image.shape != truth.shape or image.ndim != 3 or image.shape[-1] != 3:
        raise ValueError(
            f"two images (H, W, 3) of one size expected, got {tuple(image.shape)} and {tuple(truth.shape)}"
        )


def psnr(image: Tensor, truth: Tensor) -> float:
    """Peak signal-to-noise ratio, -10 log10(mean squared error), in dB; infinity for identical images."""
    _check(image, truth)
    error = float((image.double() - truth.double()).square().mean())
    return -10 * math.log10(error) if error != 0 else math.inf


def ssim(image: Tensor, truth: Tensor, mask: Tensor | None = None) -> float | None:
    """Structural similarity in [-1, 1], 1 for identical images (scikit-image).

    Gaussian window of sigma 1.5 and 11 x 11 pixels, K1 = 0.01, K2 = 0.03, data range 1, biased covariances, mean over
    the pixels whose window lies inside the image and over the channels: the settings of Wang et al. 2004 and of
    torchmetrics with data_range=1. Where a side is below 11 pixels, the window is the largest odd one that fits and its
    sigma is its radius / 3.5; None below 3 pixels.

    mask: (H, W) bool; the mean is then over the windows without a masked pixel, and None if there are none.
    """
    _check(image, truth)
    side = min(image.shape[:2])
    if side < 3:
        return None
    radius = min(_RADIUS, (side - 1) // 2)
    value, values = structural_similarity(
        image.detach().double().cpu().numpy(),
        truth.detach().double().cpu().numpy(),
        channel_axis=-1,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5 if radius == _RADIUS else radius / 3.5,
        use_sample_covariance=False,
        full=True,
    )
    if mask is None:
        return float(value)
    inside = binary_erosion(mask.cpu().numpy(), np.ones((2 * radius + 1,) * 2), border_value=0)
    return float(values[inside].mean()) if inside.any() else None


def explained(image: Tensor, truth: Tensor) -> float | None:
    """Share of the variance of true colours (N, 3) that the image's explain: 1 - squared error / variance.

    The best single colour everywhere has 0. None where all true colours are the same.
    """
    variance = (truth - truth.mean(0)).square().mean() if len(truth) else truth.new_zeros(())
    return 1 - float((image - truth).square().mean() / variance) if float(variance) > 1e-12 else None


def octaves_of(sides: Sequence[int]) -> np.ndarray:
    """Octave of each coefficient of the cosine transform (DCT-II) on a lattice of square cells; 0: the mean.

    Octave k is from 2^(k-1) to below 2^k cycles along the longest side; the first begins above 0. The last one of the
    lattice, or the eighth, goes on to the highest frequency.

    >>> octaves_of([8])
    array([0, 1, 1, 1, 2, 2, 2, 2])
    """
    longest = max(sides)
    cycles = [np.arange(side) / 2 * longest / side for side in sides]  # along the longest side
    frequency = np.sqrt(sum(axis**2 for axis in np.meshgrid(*cycles, indexing="ij")))
    last = min(math.ceil(math.log2(max(longest, 3) / 2)), len(OCTAVES))
    octave = np.minimum(np.floor(np.log2(np.maximum(frequency, 1))).astype(int) + 1, last)
    return np.where(frequency > 0, octave, 0)


def octave_energies(values: Tensor) -> np.ndarray:
    """Energy of values (..., C) on a lattice, such as (H, W, 3) or (N, 1), in each octave of spatial frequency.

    The cosine transform continues the values by reflection, so that borders do not have to fit together and no window
    is needed. It is orthonormal: the energies add up to the sum of squares (Parseval).

    Returns:
        (1 + octaves,): of the mean, then of octave 1, 2, ... (`octaves_of`); float64.
    """
    octave = octaves_of(values.shape[:-1])
    power = dctn(values.detach().double().cpu().numpy(), axes=range(octave.ndim), norm="ortho") ** 2
    return np.bincount(octave.ravel(), power.sum(-1).ravel())


def octave_errors(fit: Tensor, truth: Tensor) -> dict[str, float | None]:
    """`error_octave_<k>` -> energy of the error over energy of the truth (`octave_energies`) in octave k.

    0 is exact, 1 as far off as a fit without that octave. None where the truth has nothing. The mean is in none.
    """
    error, known = octave_energies(fit - truth)[1:], octave_energies(truth)
    there = known[1:] > 1e-20 * known.sum()  # less is rounding
    ratios = error / np.where(there, known[1:], 1)
    return {key: float(ratio) if some else None for key, ratio, some in zip(OCTAVES, ratios, there, strict=False)}


def depth_error(depth: Tensor, truth: Tensor) -> tuple[float, float]:
    """How far a depth map (H, W) is from the true one, over the pixels whose true depth is finite and above 0.

    Both numbers are robust: a ray through a hole has a depth of hundreds, which would dominate a plain mean.

    Returns:
        Mean of |depth - truth| / max(depth, truth), in [0, 1), and median of |depth - truth| in world units. Both are
        NaN where no true depth is known.
    """
    if depth.shape != truth.shape:
        raise ValueError(f"two depth maps of one size expected, got {tuple(depth.shape)} and {tuple(truth.shape)}")
    depth, truth = depth.double(), truth.double().to(depth.device)
    known = torch.isfinite(truth) & (truth > 0)
    if not bool(known.any()):
        return math.nan, math.nan
    depth, truth = depth[known], truth[known]
    error = (depth - truth).abs()
    return float((error / torch.maximum(depth, truth)).mean()), float(error.median())


@IMAGE_METRICS.register("psnr")
def _psnr(view: Comparison) -> Measured:
    return psnr(view.color, view.truth) if view.mask is None else _psnr_of(view, view.mask)


@IMAGE_METRICS.register("psnr_view_dependent")
def _psnr_view_dependent(view: Comparison) -> Measured:
    return None if view.specular is None else _psnr_of(view, view.specular >= VIEW_DEPENDENT)


@IMAGE_METRICS.register("psnr_diffuse")
def _psnr_diffuse(view: Comparison) -> Measured:
    return None if view.specular is None else _psnr_of(view, view.specular < VIEW_DEPENDENT)


def _psnr_of(view: Comparison, chosen: Tensor) -> float | None:
    """Of the chosen pixels that are not masked; None where there are none."""
    counted = chosen if view.mask is None else chosen & view.mask
    return psnr(view.color[counted][None], view.truth[counted][None]) if bool(counted.any()) else None


@IMAGE_METRICS.register("ssim")
def _ssim(view: Comparison) -> Measured:
    return ssim(view.color, view.truth, view.mask) if view.stride == 1 else None


@IMAGE_METRICS.register("lpips")
def _lpips(view: Comparison) -> Measured:
    if view.stride > 1:
        return None, "only some rows and columns were rendered"
    if view.mask is not None and not bool(view.mask.all()):
        return None, "masked pixels cannot be left out of it"
    return lpips(view.color, view.truth)


@IMAGE_METRICS.register("explained")
def _explained(view: Comparison) -> Measured:
    counted = torch.ones(view.truth.shape[:2], dtype=torch.bool)
    for part in (view.mask, view.solid):
        counted = counted if part is None else counted & part.to(counted.device)
    return explained(view.color[counted], view.truth[counted])


@IMAGE_METRICS.register("depth_error")
def _depth_error(view: Comparison) -> Measured:
    return None if view.true_depth is None else _depth_errors(view)[0]


@IMAGE_METRICS.register("depth_error_median")
def _depth_error_median(view: Comparison) -> Measured:
    return None if view.true_depth is None else _depth_errors(view)[1]


def _depth_errors(view: Comparison) -> tuple[float, float]:
    assert view.true_depth is not None
    counted = view.true_depth if view.mask is None else view.true_depth.where(view.mask, torch.inf)
    return depth_error(view.depth, counted)


for _key in OCTAVES:
    IMAGE_METRICS.register(_key)(lambda view, key=_key: view.octaves.get(key))
