"""Image files of a scene: found only inside its folder, checked before decoding, reduced with an area filter."""

import contextlib
import io
import os
import posixpath
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from qnerf.config import memory
from qnerf.config.checks import at_least
from qnerf.scenes.area import area_downscale, area_means, area_resize
from qnerf.scenes.base import digest

SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "PPM")  # other decoders may run programs, or read no picture
SMALLER = (2, 4, 8)  # factors in the names of folders with reduced images: images_2, images_4, images_8
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


def find_smaller(folder: Path, name: str) -> Path | None:
    """The image in `images_2`, `images_4` or `images_8` that stands for `images/...`, the largest; None: there is none.

    Its suffix may be another one.
    """
    first, _, rest = posixpath.normpath(name).partition("/")
    found = (
        find_image(folder, f"{first}_{factor}/{other}")
        for factor in SMALLER
        for other in (rest, posixpath.splitext(rest)[0])
        if rest
    )
    return next((path for path in found if path is not None), None)


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


def check_downscale(label: str, downscale: int, width: int, height: int) -> None:
    """ValueError unless `downscale` leaves at least one pixel."""
    at_least(f"{label}: downscale", downscale, 1)
    if downscale > min(width, height):
        raise ValueError(f"{label}: downscale={downscale} is larger than the images, {width} x {height} pixels")


def reduced_sizes(label: str, files: Sequence[ImageFile], downscale: int, width: int | None) -> list[tuple[int, int]]:
    """Width and height to which each image is reduced.

    Args:
        label: of the scene, for messages.
        downscale: the factor of all images; a remainder is dropped.
        width: that of images which are wider, in pixels; the others stay as they are. None: `downscale` decides.

    Raises:
        ValueError: both options are set, or one leaves no pixel or no smaller image.
    """
    if width is None:
        for file in files:
            check_downscale(label, downscale, file.width, file.height)
        return [(file.width // downscale, file.height // downscale) for file in files]
    if downscale != 1:
        raise ValueError(f"{label}: set downscale or width, not both, got downscale={downscale} and width={width}")
    widest = max(file.width for file in files)
    if width > widest:
        raise ValueError(f"{label}: width={width} is more than the images have, {widest} pixels")
    return [
        (width, max(1, round(file.height * width / file.width))) if file.width > width else (file.width, file.height)
        for file in files
    ]


def check_memory(what: str, pixels: int, bytes_per_pixel: int, extra: int = 0) -> None:
    """ValueError if the pixels would need more than `MAX_SCENE_BYTES`, or more memory than there is.

    extra: bytes that are needed while the scene is made.
    """
    size, hint = pixels * bytes_per_pixel, "use a larger downscale"
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


def read_images(
    folder: Path, files: Sequence[ImageFile], sizes: Sequence[tuple[int, int]], downscale: int
) -> tuple[NDArray[np.uint8], list[str]]:
    """Decodes and reduces the images: (V, H, W, 3 or 4) uint8, and a hash of each file. Images of differing size are
    (P, 3 or 4), view after view.

    There are 4 channels if any pixel of any image is not opaque. The images are in memory once.

    Args:
        sizes: width and height to which each image is reduced.
        downscale: reduce by this factor; 1: to `sizes`, by the exact shares of the pixels' areas.

    Raises:
        ValueError: an image does not decode (the message names it), or together they need too much memory.
    """
    full = max(file.width * file.height for file in files)
    ends = np.cumsum([width * height for width, height in sizes])
    channels = 4 if any(file.alpha for file in files) else 3
    workers = min(os.cpu_count() or 1, DECODERS, MAX_PIXELS // full, len(files))
    reduced = any((file.width, file.height) != size for file, size in zip(files, sizes, strict=True))
    each = max(file.size for file in files) + full * (REDUCING_BYTES if reduced else DECODING_BYTES)
    width, height = max(sizes)
    upto = "" if len(set(sizes)) == 1 else "up to "
    what = f"{folder}: {len(files)} images of {upto}{width} x {height} pixels"
    check_memory(what, int(ends[-1]), channels, workers * each)

    def read(view: int) -> tuple[str, bool]:
        """Fills the view's pixels; returns the file's hash, and whether all pixels are opaque."""
        data, pixels = _decode(folder, files[view], _pixels)
        pixels = area_downscale(pixels, downscale) if downscale > 1 else area_resize(pixels, *sizes[view])
        flat = pixels.reshape(-1, pixels.shape[-1])
        target = images[ends[view] - len(flat) : ends[view]]
        target[:, : flat.shape[1]] = flat
        target[:, flat.shape[1] :] = 255
        return digest(data), flat.shape[1] == 3 or bool((flat[:, 3] == 255).all())

    with out_of_memory(f"{folder}"):
        images = np.empty((ends[-1], channels), np.uint8)
        with ThreadPoolExecutor(workers) as pool:
            hashes, opaque = zip(*pool.map(read, range(len(files))), strict=True)
        if channels == 4 and all(opaque):
            _drop_alpha(images, int(max(np.diff(ends, prepend=0))))
    return _stacked(images, sizes), list(hashes)


def read_masks(
    folder: Path,
    files: Sequence[ImageFile],
    masks: Sequence[ImageFile | None],
    sizes: Sequence[tuple[int, int]],
    downscale: int,
) -> tuple[NDArray[np.bool_] | None, list[str | None]]:
    """The masks in the arrangement of `read_images` without channels, and a hash of each file; None without any mask.

    A pixel counts if no pixel that it was made from is black in the mask.

    Raises:
        ValueError: a mask does not decode, or its size is not its image's.
    """
    if not any(masks):
        return None, [None] * len(files)
    parts: list[NDArray[np.bool_]] = []
    hashes: list[str | None] = []
    for file, mask, (width, height) in zip(files, masks, sizes, strict=True):
        if mask is None:
            parts.append(np.ones(width * height, dtype=bool))
            hashes.append(None)
            continue
        if (mask.width, mask.height) != (file.width, file.height):
            raise ValueError(
                f"{folder}: mask {mask.name!r} has {mask.width} x {mask.height} pixels, its image {file.name!r} "
                f"{file.width} x {file.height}"
            )
        data, black = _decode(folder, mask, lambda image: np.asarray(image.convert("L")) == 0)
        if downscale > 1:
            black = black[: height * downscale, : width * downscale]
        shares = area_means(black[..., None].astype(np.float32), width, height)
        parts.append(shares.reshape(-1) == 0)
        hashes.append(digest(data))
    return _stacked(np.concatenate(parts), sizes), hashes


def _decode(folder: Path, file: ImageFile, pixels: Callable[[Image.Image], NDArray[Any]]) -> tuple[bytes, NDArray[Any]]:
    """The file's bytes, and what `pixels` makes of its image. ValueError names the file."""
    try:
        data = file.path.read_bytes()
        with Image.open(io.BytesIO(data), formats=FORMATS) as image:
            if image.size != (file.width, file.height) or _may_be_transparent(image) != file.alpha:
                raise ValueError("it changed while it was read")
            return data, pixels(image)
    except MemoryError:
        raise
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


def _drop_alpha(images: NDArray[np.uint8], part: int) -> None:
    """(P, 4) -> (P, 3) in place, `part` pixels at a time, so that the images are never in memory twice."""
    pixels, flat = len(images), images.reshape(-1)
    for first in range(0, pixels, part):
        colors = images[first : first + part, :3].reshape(-1)
        flat[3 * first : 3 * first + colors.size] = colors
    del flat
    images.resize((pixels, 3), refcheck=False)


def _reason(error: Exception) -> str:
    if isinstance(error, Image.UnidentifiedImageError):
        return f"not one of {', '.join(FORMATS)}"
    text = str(error).splitlines()
    return text[0] if text else type(error).__name__
