"""Image files of a scene: found only inside its folder, checked before decoding, reduced with an area filter."""

import io
import os
import posixpath
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from qnerf.config.checks import at_least
from qnerf.scenes.base import digest

SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "PPM")  # other decoders may run programs, or read no picture
MAX_PIXELS = 64 * 2**20  # of one image
MAX_FILE_BYTES = 2**30
MAX_SCENE_BYTES = 16 * 2**30
DECODERS = 4  # images decoded at a time; fewer if together they have more than `MAX_PIXELS`


@dataclass(frozen=True)
class ImageFile:
    """An image inside the scene's folder; `name` is its path relative to the folder."""

    name: str
    path: Path
    width: int  # pixels, as the file's header says
    height: int


def find_image(folder: Path, name: str) -> Path | None:
    """The image file `name`, written with or without its suffix; None if it does not exist.

    Raises:
        ValueError: the name, or a symbolic link on its way, points outside the folder.
    """
    refusal = f"{folder}: image {name!r} lies outside the scene's folder; image paths must be relative and inside it"
    if "\0" in name:
        raise ValueError(f"{folder}: image name {name!r} holds a null character")
    if posixpath.isabs(name) or os.path.isabs(name) or posixpath.normpath(name).split("/")[0] == "..":
        raise ValueError(refusal)
    root = folder.resolve()
    for suffix in SUFFIXES:
        path = folder / (name + suffix)
        try:
            if not path.is_file():
                continue
            if not path.resolve().is_relative_to(root):
                raise ValueError(refusal)
        except OSError:  # a name too long for the file system, a loop of links
            continue
        return path
    return None


def open_header(folder: Path, name: str, path: Path) -> ImageFile:
    """Reads the image's size without decoding it. ValueError if it is no image, or too large to decode."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # refused below, at a lower limit
            with Image.open(path, formats=FORMATS) as image:
                width, height = image.size
    except Image.DecompressionBombError:
        width = height = 2**31
    except Exception as error:
        raise ValueError(f"{folder}: image {name!r} cannot be read: {_reason(error)}") from error
    if width * height > MAX_PIXELS:
        raise ValueError(
            f"{folder}: image {name!r} is larger than {MAX_PIXELS // 2**20} megapixels and was not decoded; "
            "scale it down first"
        )
    if path.stat().st_size > MAX_FILE_BYTES:
        raise ValueError(f"{folder}: image {name!r} is a file of more than 1 GiB and was not read")
    relative = path.relative_to(folder).as_posix()
    return ImageFile(relative, path, width, height)


def common_size(folder: Path, files: Sequence[ImageFile]) -> tuple[int, int]:
    """Width and height of the images; ValueError names the first whose size differs."""
    first = files[0]
    for file in files:
        if (file.width, file.height) != (first.width, first.height):
            raise ValueError(
                f"{folder}: images must have one size: {first.name!r} has {first.width} x {first.height} pixels, "
                f"{file.name!r} has {file.width} x {file.height}"
            )
    return first.width, first.height


def check_downscale(label: str, downscale: int, width: int, height: int) -> None:
    """ValueError unless `downscale` leaves at least one pixel."""
    at_least(f"{label}: downscale", downscale, 1)
    if downscale > min(width, height):
        raise ValueError(f"{label}: downscale={downscale} is larger than the images, {width} x {height} pixels")


def check_memory(label: str, views: int, width: int, height: int, bytes_per_pixel: int) -> None:
    """ValueError if the scene would need more than `MAX_SCENE_BYTES`."""
    size = views * width * height * bytes_per_pixel
    if size > MAX_SCENE_BYTES:
        raise ValueError(
            f"{label}: {views} images of {width} x {height} pixels would need {size / 2**30:.0f} GiB; "
            "use a larger downscale"
        )


def read_images(folder: Path, files: Sequence[ImageFile], downscale: int) -> tuple[NDArray[np.uint8], str]:
    """Decodes and reduces the images: (V, H // downscale, W // downscale, 3 or 4) uint8, and a hash of the files.

    There are 4 channels if any pixel of any image is not opaque.

    Raises:
        ValueError: an image does not decode (the message names it), or together they need too much memory.
    """
    check_memory(f"{folder}", len(files), files[0].width // downscale, files[0].height // downscale, 4)

    def read(file: ImageFile) -> tuple[NDArray[np.uint8], str]:
        try:
            data = file.path.read_bytes()
            with Image.open(io.BytesIO(data), formats=FORMATS) as image:
                if image.size != (file.width, file.height):
                    raise ValueError("it changed while it was read")
                pixels = _pixels(image)
        except Exception as error:
            raise ValueError(f"{folder}: image {file.name!r} does not decode: {_reason(error)}") from error
        return area_downscale(pixels, downscale), digest(data)

    workers = min(os.cpu_count() or 1, DECODERS, MAX_PIXELS // (files[0].width * files[0].height))
    with ThreadPoolExecutor(workers) as pool:
        images, hashes = zip(*pool.map(read, files), strict=True)
    if all(image.shape[-1] == 3 or bool((image[..., 3] == 255).all()) for image in images):
        return np.stack([image[..., :3] for image in images]), digest(*hashes)
    return np.stack([_with_alpha(image) for image in images]), digest(*hashes)


def area_downscale(image: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Means over blocks of `factor` x `factor` pixels, rounded half up. A remainder at the right and bottom is dropped.

    The means are of the sRGB-encoded values. Colours are weighted by alpha.

    >>> area_downscale(np.array([[[1, 1, 1], [2, 2, 2]], [[2, 2, 2], [2, 2, 2]]], np.uint8), 2).tolist()
    [[[2, 2, 2]]]
    """
    if factor == 1:
        return image
    height, width = image.shape[0] // factor, image.shape[1] // factor
    blocks = image[: height * factor, : width * factor].reshape(height, factor, width, factor, -1)
    area = factor * factor
    sums = blocks.sum(axis=(1, 3), dtype=np.int64)
    if blocks.shape[-1] == 3:
        return ((2 * sums + area) // (2 * area)).astype(np.uint8)
    weight = sums[..., 3:]
    weighted = blocks[..., :3].astype(np.uint16) * blocks[..., 3:]  # 255^2 fits
    colors = weighted.sum(axis=(1, 3), dtype=np.int64)
    safe = np.maximum(weight, 1)
    mean = np.concatenate([(2 * colors + safe) // (2 * safe), (2 * weight + area) // (2 * area)], axis=-1)
    return mean.astype(np.uint8)


def _pixels(image: Image.Image) -> NDArray[np.uint8]:
    """An image of any of Pillow's modes as (H, W, 3 or 4) uint8."""
    if image.mode.startswith("I"):  # 16 bits a pixel, grey
        grey = np.clip(np.asarray(image), 0, 65535).astype(np.uint32)
        return np.repeat(((grey + 128) // 257).astype(np.uint8)[..., None], 3, axis=2)
    if image.mode == "F":
        raise ValueError("floating-point pixels; expected 8 or 16 bits a channel")
    alpha = "A" in image.getbands() or "transparency" in image.info
    return np.asarray(image.convert("RGBA" if alpha else "RGB"))


def _with_alpha(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    if image.shape[-1] == 4:
        return image
    return np.concatenate([image, np.full((*image.shape[:2], 1), 255, np.uint8)], axis=-1)


def _reason(error: Exception) -> str:
    if isinstance(error, Image.UnidentifiedImageError):
        return f"not one of {', '.join(FORMATS)}"
    text = str(error).splitlines()
    return text[0] if text else type(error).__name__
