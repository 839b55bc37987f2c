"""The pictures of a run, `images/*.png`: which there are, and their one reader."""

import io
from pathlib import Path

import numpy as np

from qnerf.records.files import read_bytes, reporting
from qnerf.records.parquet import reading

MAX_BYTES = 2**28


def listed(run_dir: str | Path) -> list[Path]:
    """The pictures of a run, sorted by name; links are left out."""
    return sorted(path for path in (Path(run_dir) / "images").glob("*.png") if path.is_file() and not path.is_symlink())


def read_png(path: Path) -> np.ndarray:
    """A PNG as (H, W, 3) uint8; StoreError if it is damaged, anything else, or larger than Pillow opens."""
    from PIL import Image  # listing runs does not need it

    with reporting(path, "read"):
        data = read_bytes(path, MAX_BYTES)
    with reading(path), Image.open(io.BytesIO(data), formats=["PNG"]) as image:
        return np.asarray(image.convert("RGB"))
