"""A run's stored pictures, `images/*.png`: truth | render | error x 4 | depth side by side, small views enlarged."""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from qnerf.records.pictures import listed, read_png


class Panels(NamedTuple):
    """The four panels of a picture, each (H, W, 3) uint8 at the resolution of the view."""

    truth: np.ndarray
    render: np.ndarray
    error: np.ndarray
    depth: np.ndarray


def pictures(run: str | Path) -> dict[str, Path]:
    """Name of a held-out view -> its picture, sorted by name; empty if the run has none."""
    return {path.stem: path for path in listed(run)}


def common_pictures(runs: Iterable[str]) -> tuple[list[str], dict[str, dict[str, Path]]]:
    """The views that every run has a picture of, sorted by name, and the `pictures` of each run."""
    stored = {run: pictures(run) for run in runs}
    return sorted(set.intersection(*map(set, stored.values()))), stored


def panels(picture: str | Path) -> Panels:
    """The panels, without the enlargement. Raises ValueError if the file is not such a picture."""
    pixels = read_png(Path(picture))
    width = pixels.shape[1]
    if width % len(Panels._fields):
        raise ValueError(f"{picture}: expected {' | '.join(Panels._fields)} of equal width, got {width} pixels")
    factor = enlargement(pixels)
    return Panels(*np.split(pixels[::factor, ::factor], len(Panels._fields), axis=1))


def enlargement(pixels: np.ndarray) -> int:
    """Side in pixels of the equal squares that make up a picture (H, 4 W, 3): views are enlarged without blending."""
    height, width = pixels.shape[0], pixels.shape[1] // len(Panels._fields)
    rows = np.flatnonzero((pixels[1:] != pixels[:-1]).any(axis=(1, 2))) + 1
    columns = np.flatnonzero((pixels[:, 1:] != pixels[:, :-1]).any(axis=(0, 2))) + 1
    return int(np.gcd.reduce(np.concatenate([[height, width], rows, columns])))
