"""Reads transforms.json as written by nerfstudio, instant-ngp and the synthetic-NeRF scenes."""

import json
import posixpath
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qnerf.config import memory
from qnerf.scenes.base import MIN_VIEWS
from qnerf.scenes.images import FileId, file_id, find_image, find_smaller
from qnerf.scenes.intrinsics import is_file_number
from qnerf.scenes.normalise import MAX_ENTRY, rigid

MAX_JSON_BYTES = 2**28
JSON_FACTOR = 8  # memory for a byte of a JSON file
READING_BYTES = 2**27  # for linear algebra: OpenBLAS ends the process if it gets no memory

_short = reprlib.repr  # of what a file holds: never long, never deep


@dataclass(frozen=True)
class Frame:
    """One frame of a transforms file."""

    name: str  # file_path as written
    file: Path | None  # the image; None: missing
    file_id: FileId | None  # equal for all names of one image file; None: missing
    matrix: NDArray  # (3, 4) float64, camera-to-world in the source's world, as written
    pose: NDArray  # (3, 4) float64, `matrix` with its rotation made orthonormal
    mask: Path | None  # a black and white image; black pixels do not count
    own: Mapping[str, Any]  # keys of this frame
    shared: Mapping[str, Any]  # keys of the whole file, overridden by the frame's

    @property
    def key(self) -> str:
        """Equal for all spellings of one path, whether or not the image exists."""
        return posixpath.normpath(self.name)


def read_json(file: Path) -> dict[str, Any]:
    """The file's JSON object. ValueError unless it has a non-empty list `frames`."""
    try:
        size = file.stat().st_size
    except OSError as error:
        raise ValueError(f"{file} cannot be read: {error.strerror}") from error
    if size > MAX_JSON_BYTES:
        raise ValueError(f"{file}: expected at most {MAX_JSON_BYTES >> 20} MiB, got {size >> 20} MiB")
    memory.require(f"{file}: reading it", READING_BYTES + JSON_FACTOR * size)
    try:
        content = json.loads(file.read_bytes().decode("utf-8-sig"))
    except OSError as error:
        raise ValueError(f"{file} cannot be read: {error.strerror}") from error
    except MemoryError:
        raise ValueError(f"{file} does not fit into memory") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file} is not JSON: {str(error).splitlines()[0]}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{file}: expected a JSON object with a list 'frames', got {type(content).__name__}")
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise ValueError(f"{file} has no frames: expected a non-empty list 'frames'")
    return content


def read_frames(folder: Path, file: Path) -> list[Frame]:
    """All frames of a transforms file; see `frames_of`."""
    return frames_of(folder, file, read_json(file))


def frames_of(folder: Path, file: Path, content: Mapping[str, Any]) -> list[Frame]:
    """All frames in the order of the content, also those whose image is missing.

    Args:
        folder: with the images.
        file: which was read, for messages.
        content: as of a transforms file.

    Raises:
        ValueError: names the first frame with a missing or repeated file_path, with the image file of an earlier frame,
            with a pose that is not rigid, or with a mask that is missing.
    """
    frames = []
    names: set[str] = set()
    images: dict[FileId, str] = {}
    for index, source in enumerate(content["frames"]):
        if not isinstance(source, dict):
            raise ValueError(f"{file}: frame {index} must be an object, got {type(source).__name__}")
        name = source.get("file_path")
        if not isinstance(name, str) or not name:
            raise ValueError(f"{file}: file_path of frame {index} must be a file name, got {_short(name)}")
        label = f"{file}: frame {name!r}"
        image = find_image(folder, name)
        smaller = None if image else find_smaller(folder, name)
        image = image or smaller
        mask = find_mask(folder, source, label, smaller=smaller is not None)
        matrix = read_matrix(source, label)
        frame = Frame(
            name, image, file_id(image) if image else None, matrix[:3], rigid(matrix, label), mask, source, content
        )
        if frame.key in names:
            raise ValueError(f"{file} names image {name!r} twice")
        names.add(frame.key)
        if frame.file_id is not None and images.setdefault(frame.file_id, name) != name:
            raise ValueError(f"{file} names one image file twice: as {images[frame.file_id]!r} and as {name!r}")
        frames.append(frame)
    return frames


def find_mask(folder: Path, source: Mapping[str, Any], label: str, *, smaller: bool) -> Path | None:
    """The frame's mask_path; smaller: look first in masks_2, masks_4 or masks_8. None: it has none."""
    name = source.get("mask_path")
    if name is None or name == "":
        return None
    if not isinstance(name, str):
        raise ValueError(f"{label}: mask_path must be a file name, got {_short(name)}")
    path = (find_smaller(folder, name) if smaller else None) or find_image(folder, name)
    if path is None:
        raise ValueError(f"{label}: mask {name!r} does not exist")
    return path


def read_matrix(source: Mapping[str, Any], label: str) -> NDArray:
    """A frame's transform_matrix as written, (3 or 4, 4) float64; ValueError unless it holds finite numbers."""
    if "transform_matrix" not in source:
        raise ValueError(f"{label} has no transform_matrix")
    rows = source["transform_matrix"]
    if not isinstance(rows, list) or not all(isinstance(row, list) for row in rows):
        raise ValueError(f"{label}: transform_matrix must be 4 x 4 numbers")
    if len(rows) not in (3, 4) or any(len(row) != 4 for row in rows):
        raise ValueError(f"{label}: transform_matrix must be 4 x 4 numbers, got rows of {[len(row) for row in rows]}")
    for value in (value for row in rows for value in row):
        if not is_file_number(value):
            wrong = f"NaN, infinity or beyond {MAX_ENTRY:g}"
            raise ValueError(f"{label}: transform_matrix must hold numbers, none {wrong}, got {_short(value)}")
    return np.array(rows, dtype=np.float64)


def with_images(folder: Path, frames: Sequence[Frame], skip_missing: bool) -> list[Frame]:
    """The frames whose image exists.

    Raises:
        ValueError: an image is missing and `skip_missing` is false, or fewer than three images exist.
    """
    missing = [frame for frame in frames if frame.file is None]
    if missing and not skip_missing:
        raise ValueError(
            f"{folder}: {len(missing)} of {len(frames)} images are missing, the first is {missing[0].name!r}; "
            "scene.skip_missing=true goes on with the rest"
        )
    existing = [frame for frame in frames if frame.file is not None]
    if len(existing) < MIN_VIEWS:
        hint = f" ({len(missing)} of {len(frames)} are missing)" if missing else ""
        raise ValueError(f"{folder}: expected at least {MIN_VIEWS} images, got {len(existing)}{hint}")
    return existing
