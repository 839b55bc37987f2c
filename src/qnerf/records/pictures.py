"""The pictures of a run, `images/*.png`: which there are, and their one reader."""

import io
from pathlib import Path

import numpy as np

from qnerf.records.files import reading, reporting


def listed(run_dir: str | Path) -> list[Path]:
    """The pictures of a run, sorted by name."""
    return sorted((Path(run_dir) / "images").glob("*.png"))


def read_png(path: Path) -> np.ndarray:
    """A PNG as (H, W, 3) uint8; StoreError if it is damaged, anything else, or larger than Pillow opens."""
    from PIL import Image  # listing runs does not need it

    with reporting(path, "read"):
        data = path.read_bytes()
    with reading(path), Image.open(io.BytesIO(data), formats=["PNG"]) as image:
        return np.asarray(image.convert("RGB"))
