"""Whether exposure or white balance differ between views."""

import numpy as np
from numpy.typing import NDArray

from qnerf.auto.views import grey, neighbours, subset
from qnerf.scenes import Scene

PAIRS = 30  # most pairs of neighbouring views to compare
COARSE = 64  # pixels: greatest height at which views are compared
ALIKE = 0.6  # correlation above which two views show the same thing
VARIES = 0.1  # a spread that harms every model
DARK, BRIGHT = 0.08, 0.92  # darker or brighter pixels say nothing about exposure


def exposure_spread(scene: Scene) -> float:
    """Standard deviation over views of the log brightness of the same surfaces; NaN if too few pairs can be compared.

    Neighbouring views are aligned by the shift that correlates them best, which a gain does not change. The gain of a
    pair is the median over pixels of the ratio of their values. Gains of pairs spread sqrt(2) times as much as views.
    """
    size = scene.cameras.size
    pairs = [(a, b) for a, b in neighbours(scene) if size(a) == size(b)]
    gains = [gain(coarse(grey(scene, a)), coarse(grey(scene, b))) for a, b in subset(pairs, PAIRS)]
    known = np.array([value for value in gains if np.isfinite(value)])
    if len(known) < 3:
        return float("nan")
    return float(np.sqrt(np.mean(known**2) / 2))


def warning(scene: Scene) -> str | None:
    """One line if brightness differs so much between views that held-out views cannot be predicted well; else None."""
    spread = exposure_spread(scene)
    if not spread > VARIES:  # also NaN
        return None
    return (
        f"the same surfaces are {np.expm1(spread):.0%} brighter or darker from one photograph to another, which keeps "
        "every held-out PSNR low, also with appearance=16; fix exposure and white balance of the camera"
    )


def coarse(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """The image reduced by block means to at most `COARSE` rows or to one column; NaN where a block has a NaN."""
    factor = min(-(-image.shape[0] // COARSE), image.shape[1])
    rows, columns = (size // factor * factor for size in image.shape)
    blocks = image[:rows, :columns].reshape(rows // factor, factor, columns // factor, factor)
    mean: NDArray[np.float64] = blocks.mean(axis=(1, 3))
    return mean


def gain(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Log of how much brighter `a` is than `b` (H, W); NaN if they do not show the same surfaces."""
    shift, correlation = best_shift(a, b)
    if correlation < ALIKE:
        return float("nan")
    here, there = overlap(a, b, shift)
    with np.errstate(invalid="ignore"):
        clear = (here > DARK) & (here < BRIGHT) & (there > DARK) & (there < BRIGHT)
    if clear.mean() < 0.05:
        return float("nan")
    return float(np.median(np.log(here[clear] / there[clear])))


def best_shift(a: NDArray[np.float64], b: NDArray[np.float64]) -> tuple[tuple[int, int], float]:
    """The shift of `b`, rows and columns, that correlates it best with `a`, and that correlation.

    Shifts are even and at most a quarter of the image.
    """
    height, width = a.shape
    best = ((0, 0), -1.0)
    for rows in range(-(height // 4), height // 4 + 1, 2):
        for columns in range(-(width // 4), width // 4 + 1, 2):
            here, there = overlap(a, b, (rows, columns))
            value = correlation(here, there)
            if value > best[1]:
                best = ((rows, columns), value)
    return best


def overlap(
    a: NDArray[np.float64], b: NDArray[np.float64], shift: tuple[int, int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The parts of `a` and `b` that overlap when `b` is moved by `shift`."""
    here = [slice(max(0, move), size + min(0, move)) for move, size in zip(shift, a.shape, strict=True)]
    there = [slice(max(0, -move), size + min(0, -move)) for move, size in zip(shift, a.shape, strict=True)]
    return a[here[0], here[1]], b[there[0], there[1]]


def correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Pearson correlation over the pixels that both have; -1 if there are few, or one image is constant."""
    both = np.isfinite(a) & np.isfinite(b)
    if both.mean() < 0.1:
        return -1.0
    x, y = a[both] - a[both].mean(), b[both] - b[both].mean()
    scale = np.sqrt((x @ x) * (y @ y))
    return float(x @ y / scale) if scale > 1e-12 else -1.0
