"""Image files of a scene, decoded and reduced with an area filter, and their masks."""

import io
import os
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from qnerf.config import memory
from qnerf.scenes.area import area_means, area_resize
from qnerf.scenes.base import digest

FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "PPM")  # other decoders may run programs, or read no picture
DECODERS = 4  # images decoded at a time
REDUCE = "use a smaller scene.width"
DECODING_BYTES = 48  # memory for a pixel of a file while it is decoded and reduced


@dataclass(frozen=True)
class ImageFile:
    """An image in the scene's folder; `name` is its path relative to the folder."""

    name: str
    path: Path
    width: int  # pixels, as the file's header says
    height: int
    alpha: bool  # whether pixels may be transparent, as the file's header says


@dataclass(frozen=True)
class Mask:
    """An image that says which pixels of another one count: not where it is black, or where it is transparent, if it is
    so anywhere."""

    file: Path
    inverted: bool = False  # the other way around


def open_header(folder: Path, path: Path) -> ImageFile:
    """Reads the size of an image in the folder without decoding it; ValueError if it is no image."""
    name = path.relative_to(folder).as_posix()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path, formats=FORMATS) as image:
                return ImageFile(name, path, *image.size, _may_be_transparent(image))
    except Exception as error:
        raise ValueError(f"{folder}: image {name!r} cannot be read: {_reason(error)}") from error


def reduced_sizes(label: str, files: Sequence[ImageFile], width: int | None) -> list[tuple[int, int]]:
    """Width and height to which each image is reduced.

    Args:
        label: of the scene, for messages.
        width: that of images which are wider, in pixels; the others stay as they are. None: all do.

    Raises:
        ValueError: no image is as wide.
    """
    widest = max(file.width for file in files)
    width = widest if width is None else width
    if width > widest:
        raise ValueError(
            f"{label}: width={width} is more than the images have, {widest} pixels; use scene.width={widest} or less"
        )
    return [
        (width, max(1, round(file.height * width / file.width))) if file.width > width else (file.width, file.height)
        for file in files
    ]


def read_images(
    folder: Path, files: Sequence[ImageFile], sizes: Sequence[tuple[int, int]]
) -> tuple[NDArray[np.uint8], list[str]]:
    """Decodes and reduces the images: (V, H, W, 3 or 4) uint8, and a hash of each file. Images of differing size are
    (P, 3 or 4), view after view.

    There are 4 channels if any pixel of any image is not opaque.

    Args:
        sizes: width and height to which each image is reduced, by the exact shares of the pixels' areas.

    Raises:
        ValueError: an image does not decode (the message names it), or together they need too much memory.
    """
    ends = np.cumsum([width * height for width, height in sizes])
    channels = 4 if any(file.alpha for file in files) else 3
    workers = min(os.cpu_count() or 1, DECODERS, len(files))
    decoding = workers * DECODING_BYTES * max(file.width * file.height for file in files)
    memory.require(f"{folder}: {len(files)} images", int(ends[-1]) * channels + decoding, hint=REDUCE)

    def read(view: int) -> tuple[str, bool]:
        """Fills the view's pixels; returns the file's hash, and whether all pixels are opaque."""
        data, pixels = _decode(folder, files[view], _pixels)
        pixels = area_resize(pixels, *sizes[view])
        flat = pixels.reshape(-1, pixels.shape[-1])
        target = images[ends[view] - len(flat) : ends[view]]
        target[:, : flat.shape[1]] = flat
        target[:, flat.shape[1] :] = 255
        return digest(data), flat.shape[1] == 3 or bool((flat[:, 3] == 255).all())

    images = np.empty((ends[-1], channels), np.uint8)
    with ThreadPoolExecutor(workers) as pool:
        hashes, opaque = zip(*pool.map(read, range(len(files))), strict=True)
    if channels == 4 and all(opaque):
        images = np.ascontiguousarray(images[:, :3])
    return _stacked(images, sizes), list(hashes)


def read_masks(
    folder: Path,
    files: Sequence[ImageFile],
    masks: Sequence[Mask | None],
    radii: Sequence[float | None],
    sizes: Sequence[tuple[int, int]],
) -> tuple[NDArray[np.bool_] | None, list[str | None]]:
    """The masks in the arrangement of `read_images` without channels, and a hash of each; None without any mask.

    A pixel counts if no pixel of the mask that it covers a part of says otherwise. A mask may be larger than its image.

    Args:
        radii: in pixels of the file; pixels farther from the middle of the image do not count, either.

    Raises:
        ValueError: a mask does not decode, or is no larger image of its image's shape.
    """
    if not any(masks) and not any(radii):
        return None, [None] * len(files)
    parts: list[NDArray[np.bool_]] = []
    hashes: list[str | None] = []
    for file, mask, radius, size in zip(files, masks, radii, sizes, strict=True):
        counts, content = np.ones(size[0] * size[1], dtype=bool), None
        if radius is not None:
            y, x = np.ogrid[: file.height, : file.width]
            outside = np.hypot(x + 0.5 - file.width / 2, y + 0.5 - file.height / 2) > radius
            counts &= _counting(outside, size)
        if mask is not None:
            excluded, content = _excluded(folder, file, mask)
            counts &= _counting(excluded, size)
        parts.append(counts)
        hashes.append(content)
    return _stacked(np.concatenate(parts), sizes), hashes


def _excluded(folder: Path, file: ImageFile, mask: Mask) -> tuple[NDArray[np.bool_], str]:
    """Which pixels of the mask say that they do not count, and the hash of the mask."""
    header = open_header(folder, mask.file)
    ratio = header.width / file.width
    if ratio < 1 or abs(header.height - ratio * file.height) >= ratio:
        raise ValueError(
            f"{folder}: mask {header.name!r} has {header.width} x {header.height} pixels; expected the "
            f"{file.width} x {file.height} of its image {file.name!r}, or a larger mask of the same shape"
        )

    def empty(image: Image.Image) -> NDArray[np.bool_]:
        if header.alpha:
            image = image.convert("RGBA")
            transparent = np.asarray(image)[..., 3] == 0
            if transparent.any():
                return transparent
        black: NDArray[np.bool_] = np.asarray(image.convert("L")) == 0
        return black

    data, left_out = _decode(folder, header, empty)
    return (~left_out, digest("inverted", data)) if mask.inverted else (left_out, digest(data))


def _counting(excluded: NDArray[np.bool_], size: tuple[int, int]) -> NDArray[np.bool_]:
    """Which pixels of the reduced image, row by row, cover no part of what is excluded."""
    return area_means(excluded.astype(np.float32)[..., None], *size).reshape(-1) == 0


def _decode(folder: Path, file: ImageFile, pixels: Callable[[Image.Image], NDArray[Any]]) -> tuple[bytes, NDArray[Any]]:
    """The file's bytes, and what `pixels` makes of its image. ValueError names the file."""
    try:
        data = file.path.read_bytes()
        with Image.open(io.BytesIO(data), formats=FORMATS) as image:
            if image.size != (file.width, file.height) or _may_be_transparent(image) != file.alpha:
                raise ValueError("it changed while it was read")
            return data, pixels(image)
    except MemoryError:
        raise ValueError(f"{folder}: image {file.name!r} does not fit into memory; {REDUCE}") from None
    except Exception as error:
        raise ValueError(f"{folder}: image {file.name!r} does not decode: {_reason(error)}") from error


def _stacked(values: NDArray[Any], sizes: Sequence[tuple[int, int]]) -> NDArray[Any]:
    """(P, ...) -> (V, H, W, ...) if all sizes are equal."""
    if len(set(sizes)) > 1:
        return values
    width, height = sizes[0]
    return values.reshape(len(sizes), height, width, *values.shape[1:])


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


def _reason(error: Exception) -> str:
    if isinstance(error, Image.UnidentifiedImageError):
        return f"not one of {', '.join(FORMATS)}"
    text = str(error).splitlines()
    return text[0] if text else type(error).__name__
