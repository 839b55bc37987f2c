"""Frames of a video, decoded by ffmpeg through the package imageio-ffmpeg."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image


def extract_frames(video: Path, folder: Path, frames: int, progress: Callable[[str, int, int], None]) -> None:
    """Writes the sharpest frame in each of `frames` equal parts of the video as 0000.jpg, 0001.jpg, ...

    Raises:
        ValueError: imageio-ffmpeg is missing, or the video does not decode.
    """
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise ValueError('reading a video needs imageio-ffmpeg: pip install "qnerf[capture]"') from error
    try:
        with warnings.catch_warnings(action="ignore", category=ResourceWarning):  # the package leaves its pipes open
            written = _write_sharpest(imageio_ffmpeg, video, folder, frames, progress)
    except (OSError, RuntimeError, StopIteration, ValueError) as error:
        reason = (str(error).strip() or "no frames").splitlines()[-1]
        raise ValueError(f"{video} does not decode as a video: {reason}") from error
    if not written:
        raise ValueError(f"{video} does not decode as a video: no frames")


def _write_sharpest(
    ffmpeg: Any, video: Path, folder: Path, frames: int, progress: Callable[[str, int, int], None]
) -> int:
    """Number of the frames written."""
    total, _ = ffmpeg.count_frames_and_secs(str(video))
    once = ["-fps_mode", "passthrough"]  # frames at uneven times, as of a telephone, are not repeated to fill the gaps
    stream = ffmpeg.read_frames(str(video), pix_fmt="rgb24", output_params=once)
    width, height = next(stream)["size"]
    best: tuple[float, Any] = (-1.0, None)
    written = 0
    for number, data in enumerate(stream):
        image = np.frombuffer(data, np.uint8).reshape(height, width, 3)
        best = max(best, (sharpness(image), image), key=lambda pair: pair[0])
        if number + 1 >= (written + 1) * total / frames:
            Image.fromarray(best[1]).save(folder / f"{written:04d}.jpg", quality=95)
            best, written = (-1.0, None), written + 1
            progress("frames", written, min(frames, total))
    return written


def sharpness(image: NDArray[np.uint8]) -> float:
    """Mean absolute difference of neighbouring grey values of an image (H, W, 3): blur lowers it."""
    grey = image[..., 1].astype(np.int16)
    return float(np.abs(np.diff(grey, axis=0)).mean() + np.abs(np.diff(grey, axis=1)).mean())
