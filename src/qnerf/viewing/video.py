"""Pictures -> an animated WebP, an mp4, or a folder of PNG files; whole or not at all."""

import contextlib
import importlib.util
import os
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from qnerf.config import memory
from qnerf.records.deletion import refuse_runs
from qnerf.records.files import replace, reporting, temporary_path

MAX_WEBP = 16_383  # pixels along a side


def check(file: Path, width: int, height: int, frames: int) -> None:
    """ValueError unless a video of this size can be written to `file`; nothing is rendered before.

    The suffix decides: .webp, .mp4, or none for a folder of PNG files.
    """
    refuse_runs(file.parent)
    kind = file.suffix.lower()
    if kind not in ("", ".webp", ".mp4"):
        raise ValueError(f"{file}: expected a name that ends in .webp or .mp4, or a folder for PNG files")
    if kind == "" and file.exists():
        raise ValueError(f"{file}: exists already; expected a new folder for the PNG files")
    if kind and file.is_dir():
        raise ValueError(f"{file}: is a folder; expected a file")
    if kind == ".webp":
        if max(width, height) > MAX_WEBP:
            raise ValueError(f"{file}: a WebP has at most {MAX_WEBP:,} pixels a side, got {width} x {height}")
        hint = "write .mp4 or PNG files, which need one frame at a time"
        memory.require(f"{file}: {frames:,} frames of {width} x {height}", 4 * width * height * frames, hint=hint)
    if kind == ".mp4":
        if width % 2 or height % 2:
            raise ValueError(f"{file}: an mp4 needs an even width and height, got {width} x {height}")
        if importlib.util.find_spec("imageio_ffmpeg") is None:
            raise ValueError('mp4 needs imageio-ffmpeg: pip install "qnerf[view]"; .webp works without')


def write(file: Path, pictures: Iterable[NDArray], fps: float) -> None:
    """Writes pictures (H, W, 3) uint8 of one size to a file that passed `check`.

    Raises:
        ValueError: it cannot be written.
    """
    with reporting(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        {".webp": _webp, ".mp4": _mp4, "": _folder}[file.suffix.lower()](file, iter(pictures), fps)


def _webp(file: Path, pictures: Iterator[NDArray], fps: float) -> None:
    first, *rest = map(Image.fromarray, pictures)
    options = {"save_all": True, "append_images": rest, "duration": round(1000 / fps), "loop": 0, "quality": 90}
    replace(file, lambda sink: first.save(sink, format="WEBP", **options))


def _mp4(file: Path, pictures: Iterator[NDArray], fps: float) -> None:
    import imageio_ffmpeg

    first = next(pictures)
    temporary = temporary_path(file)
    options = {"fps": fps, "macro_block_size": 2, "quality": 8, "output_params": ["-f", "mp4"]}
    writer = imageio_ffmpeg.write_frames(str(temporary), first.shape[1::-1], **options)
    try:
        with contextlib.closing(writer):
            writer.send(None)
            writer.send(np.ascontiguousarray(first))
            for picture in pictures:
                writer.send(np.ascontiguousarray(picture))
        os.replace(temporary, file)
    finally:
        temporary.unlink(missing_ok=True)


def _folder(folder: Path, pictures: Iterator[NDArray], _: float) -> None:
    temporary = temporary_path(folder)
    temporary.mkdir()
    try:
        for number, picture in enumerate(pictures):
            Image.fromarray(picture).save(temporary / f"{number:05}.png")
        os.rename(temporary, folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
