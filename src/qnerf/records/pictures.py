"""The pictures of a run, `images/*.png`: which there are, and their one reader."""

import io
import struct
from pathlib import Path

import numpy as np

from qnerf.records.files import StoreError, read_bytes, reporting
from qnerf.records.parquet import reading

MAX_BYTES = 2**28
MAX_PIXELS = 2**25  # four panels of 3840 x 2160; Pillow warns of decompression bombs from 2.7 times as many
_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def listed(run_dir: str | Path) -> list[Path]:
    """The pictures of a run, sorted by name; links are left out."""
    return sorted(path for path in (Path(run_dir) / "images").glob("*.png") if path.is_file() and not path.is_symlink())


def read_png_bytes(path: Path) -> tuple[bytes, int, int]:
    """A PNG as it is, with its width and height in pixels; StoreError if it is anything else or has too many pixels."""
    with reporting(path, "read"):
        data = read_bytes(path, MAX_BYTES)
    if not data.startswith(_SIGNATURE) or len(data) < 24:
        raise StoreError(f"{path}: not readable as a picture: expected a PNG")
    width, height = struct.unpack(">II", data[16:24])
    if width * height > MAX_PIXELS:
        raise StoreError(f"{path}: has {width:,} x {height:,} pixels; expected at most {MAX_PIXELS:,}")
    return data, width, height


def read_png(path: Path) -> np.ndarray:
    """A PNG as (H, W, 3) uint8; StoreError if it is damaged, anything else, or has too many pixels."""
    from PIL import Image  # listing runs does not need it

    data, _, _ = read_png_bytes(path)
    with reading(path), Image.open(io.BytesIO(data), formats=["PNG"]) as image:
        return np.asarray(image.convert("RGB"))
