"""Image files of a scene: found only inside its folder, checked before decoding, reduced with an area filter."""

import contextlib
import io
import os
import posixpath
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from qnerf.config import memory
from qnerf.config.checks import at_least
from qnerf.scenes.base import digest

SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "PPM")  # other decoders may run programs, or read no picture
MAX_PIXELS = 64 * 2**20  # of one image
MAX_FILE_BYTES = 2**30
MAX_SCENE_BYTES = 16 * 2**30
DECODERS = 4  # images decoded at a time; fewer if together they have more than `MAX_PIXELS`
DECODING_BYTES, REDUCING_BYTES = 16, 48  # memory for a pixel of a file while it is decoded, and reduced

FileId = tuple[int | str, ...]


@dataclass(frozen=True)
class ImageFile:
    """An image inside the scene's folder; `name` is its path relative to the folder."""

    name: str
    path: Path
    width: int  # pixels, as the file's header says
    height: int
    size: int  # bytes
    alpha: bool  # whether pixels may be transparent, as the file's header says


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


def file_id(path: Path) -> FileId:
    """Equal for all names of one file: through links, hard links, and other case where the file system ignores it."""
    status = path.stat()
    if not status.st_ino:  # the file system does not number its files
        return (str(path.resolve()),)
    # Some network file systems give one number to several files: size and time tell them apart.
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def open_header(folder: Path, name: str, path: Path) -> ImageFile:
    """Reads the image's size without decoding it. ValueError if it is no image, or too large to decode."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # refused below, at a lower limit
            with Image.open(path, formats=FORMATS) as image:
                width, height = image.size
                alpha = _may_be_transparent(image)
    except Image.DecompressionBombError:
        width, height, alpha = 2**31, 2**31, False
    except Exception as error:
        raise ValueError(f"{folder}: image {name!r} cannot be read: {_reason(error)}") from error
    if width * height > MAX_PIXELS:
        raise ValueError(
            f"{folder}: image {name!r} is larger than {MAX_PIXELS // 2**20} megapixels and was not decoded; "
            "scale it down first"
        )
    size = path.stat().st_size
    if size > MAX_FILE_BYTES:
        raise ValueError(f"{folder}: image {name!r} is a file of more than 1 GiB and was not read")
    relative = path.relative_to(folder).as_posix()
    return ImageFile(relative, path, width, height, size, alpha)


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


def check_memory(label: str, views: int, width: int, height: int, bytes_per_pixel: int, extra: int = 0) -> None:
    """ValueError if the scene would need more than `MAX_SCENE_BYTES`, or more memory than there is.

    extra: bytes that are needed while the scene is made.
    """
    size = views * width * height * bytes_per_pixel
    what, hint = f"{label}: {views} images of {width} x {height} pixels", "use a larger downscale"
    if size > MAX_SCENE_BYTES:
        limit = f"the limit is {MAX_SCENE_BYTES / 2**30:g} GiB"
        raise ValueError(f"{what} would need {size / 2**30:.0f} GiB; {limit}; {hint}")
    memory.require(what, size + extra, hint=hint)


@contextlib.contextmanager
def out_of_memory(label: str) -> Iterator[None]:
    """Turns a MemoryError, or a thread that cannot start, into a one-line ValueError."""
    try:
        yield
    except MemoryError:
        raise ValueError(f"{label} does not fit into memory; use a larger downscale") from None
    except RuntimeError as error:
        if "can't start new thread" not in str(error):
            raise
        raise ValueError(f"{label}: {error}: too little memory, or too many threads") from None


def read_images(folder: Path, files: Sequence[ImageFile], downscale: int) -> tuple[NDArray[np.uint8], list[str]]:
    """Decodes and reduces the images: (V, H // downscale, W // downscale, 3 or 4) uint8, and a hash of each file.

    There are 4 channels if any pixel of any image is not opaque. The images are in memory once.

    Raises:
        ValueError: an image does not decode (the message names it), or together they need too much memory.
    """
    full = files[0].width * files[0].height
    width, height = files[0].width // downscale, files[0].height // downscale
    channels = 4 if any(file.alpha for file in files) else 3
    workers = min(os.cpu_count() or 1, DECODERS, MAX_PIXELS // full, len(files))
    each = max(file.size for file in files) + full * (DECODING_BYTES if downscale == 1 else REDUCING_BYTES)
    check_memory(f"{folder}", len(files), width, height, channels, workers * each)

    def read(view: int) -> tuple[str, bool]:
        """Fills images[view]; returns the file's hash, and whether all pixels are opaque."""
        file = files[view]
        try:
            data = file.path.read_bytes()
            with Image.open(io.BytesIO(data), formats=FORMATS) as image:
                if image.size != (file.width, file.height) or _may_be_transparent(image) != file.alpha:
                    raise ValueError("it changed while it was read")
                pixels = area_downscale(_pixels(image), downscale)
        except MemoryError:
            raise
        except Exception as error:
            raise ValueError(f"{folder}: image {file.name!r} does not decode: {_reason(error)}") from error
        images[view, ..., : pixels.shape[-1]] = pixels
        images[view, ..., pixels.shape[-1] :] = 255
        return digest(data), pixels.shape[-1] == 3 or bool((pixels[..., 3] == 255).all())

    with out_of_memory(f"{folder}"):
        images = np.empty((len(files), height, width, channels), np.uint8)
        with ThreadPoolExecutor(workers) as pool:
            hashes, opaque = zip(*pool.map(read, range(len(files))), strict=True)
        if channels == 4 and all(opaque):
            _drop_alpha(images)
    return images, list(hashes)


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
    return np.asarray(image.convert("RGBA" if _may_be_transparent(image) else "RGB"))


def _may_be_transparent(image: Image.Image) -> bool:
    return not image.mode.startswith("I") and ("A" in image.getbands() or "transparency" in image.info)


def _drop_alpha(images: NDArray[np.uint8]) -> None:
    """(V, H, W, 4) -> (V, H, W, 3) in place, so that the images are never in memory twice."""
    views, height, width, _ = images.shape
    flat, size = images.reshape(-1), height * width * 3
    for view in range(views):
        flat[view * size : (view + 1) * size] = images[view, ..., :3].reshape(-1)
    del flat
    images.resize((views, height, width, 3), refcheck=False)


def _reason(error: Exception) -> str:
    if isinstance(error, Image.UnidentifiedImageError):
        return f"not one of {', '.join(FORMATS)}"
    text = str(error).splitlines()
    return text[0] if text else type(error).__name__
