"""A run's stored pictures, `images/*.png`: truth | render | error x 4 | depth side by side, small views enlarged."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from qnerf.records.pictures import listed, read_png

PANELS = ("truth", "render", "error", "depth")


def pictures(run: str | Path) -> dict[str, Path]:
    """Name of a held-out view -> its picture, sorted by name; empty if the run has none."""
    return {path.stem: path for path in listed(run)}


def common_pictures(runs: Iterable[str]) -> tuple[list[str], dict[str, dict[str, Path]]]:
    """The views that every run has a picture of, sorted by name, and the `pictures` of each run."""
    stored = {run: pictures(run) for run in runs}
    return sorted(set.intersection(*map(set, stored.values()))), stored


def split(picture: str | Path, names: Sequence[str]) -> list[np.ndarray]:
    """The panels of these names, which stand side by side. A signal's picture has no depth. ValueError as `panels`."""
    pixels = read_png(Path(picture))
    width = pixels.shape[1]
    if width % len(names):
        raise ValueError(f"{picture}: expected {' | '.join(names)} of equal width, got {width} pixels")
    factor = enlargement(pixels, len(names))
    return np.split(pixels[::factor, ::factor], len(names), axis=1)


def panels(picture: str | Path, *, signal: bool = False) -> dict[str, np.ndarray]:
    """The panels by name, each (H, W, 3) uint8 at the resolution of the view, without the enlargement.

    A signal's picture is truth | fit | error. ValueError if the file is not such a picture.
    """
    names = PANELS[: 3 if signal else 4]
    return dict(zip(names, split(picture, names), strict=True))


def enlargement(pixels: np.ndarray, count: int = len(PANELS)) -> int:
    """Side in pixels of the equal squares that make up a picture (H, count * W, 3): views are enlarged unblended."""
    height, width = pixels.shape[0], pixels.shape[1] // count
    rows = np.flatnonzero((pixels[1:] != pixels[:-1]).any(axis=(1, 2))) + 1
    columns = np.flatnonzero((pixels[:, 1:] != pixels[:, :-1]).any(axis=(0, 2))) + 1
    return int(np.gcd.reduce(np.concatenate([[height, width], rows, columns])))
