"""Reads transforms.json as written by nerfstudio, instant-ngp and the synthetic-NeRF scenes."""

import json
import math
import posixpath
import re
import reprlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qnerf.scenes.folders import SceneFolder
from qnerf.scenes.images import Mask
from qnerf.scenes.intrinsics import FOCAL, LENS, is_file_number, stated_numbers
from qnerf.scenes.loading import PosedImage, shortened
from qnerf.scenes.normalise import MAX_ENTRY

MASKS = ("mask_path", "mask_file_path", "mask_filename", "mask_file")
"""Keys of a mask, of a frame or of the whole file; its black pixels do not count."""
DYNAMIC = "dynamic_mask_"  # instant-ngp's mask lies beside the image; pixels that are not black do not count
FIELDS_OF_VIEW = {"x_fov": "camera_angle_x", "y_fov": "camera_angle_y"}  # degrees, of instant-ngp
FRAME_KEYS = {"file_path", "transform_matrix", "K", *FIELDS_OF_VIEW, *LENS, *MASKS}
FILE_KEYS = {"frames", "train_filenames", "val_filenames", "test_filenames", "K", *FIELDS_OF_VIEW, *LENS, *MASKS}
COMMENTS = re.compile(r'("(?:[^"\\]|\\.)*")|//[^\n]*|/\*.*?\*/', re.DOTALL)  # outside of texts; instant-ngp skips them

_short = reprlib.repr  # of what a file holds: never long, never deep


def read_json(file: Path) -> dict[str, Any]:
    """The file's JSON object. ValueError unless it has a non-empty list `frames`."""
    try:
        content = json.loads(COMMENTS.sub(r"\1", file.read_bytes().decode("utf-8-sig")))
    except OSError as error:
        raise ValueError(f"{file} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file} is not JSON: {str(error).splitlines()[0]}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{file}: expected a JSON object with a list 'frames', got {type(content).__name__}")
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise ValueError(f"{file} has no frames: expected a non-empty list 'frames'")
    return content


def posed_images(folder: SceneFolder, file: Path, content: Mapping[str, Any]) -> list[PosedImage]:
    """All frames in the order of the content, also those whose image is missing.

    Args:
        file: which was read, for messages.
        content: of a transforms file.

    Raises:
        ValueError: names the first frame without file_path, without a pose, or with a mask that is missing.
    """
    images = []
    for index, frame in enumerate(content["frames"]):
        if not isinstance(frame, dict):
            raise ValueError(f"{file}: frame {index} must be an object, got {type(frame).__name__}")
        name = frame.get("file_path")
        if not isinstance(name, str) or not name:
            raise ValueError(f"{file}: file_path of frame {index} must be a file name, got {_short(name)}")
        label = f"{file}: frame {name!r}"
        image = folder.image(name)
        smaller = None if image else folder.smaller(name)
        mask = find_mask(folder, {**content, **frame}, image or smaller, label, reduced=smaller is not None)
        lens = merged_lens(content, frame, label)
        images.append(PosedImage(name, image or smaller, read_matrix(frame, label), lens, mask))
    return images


def normal(name: str) -> str:
    """Equal for all spellings of one path, whether or not the image exists."""
    return posixpath.normpath(name.replace("\\", "/"))


def find_mask(
    folder: SceneFolder, frame: Mapping[str, Any], image: Path | None, label: str, *, reduced: bool
) -> Mask | None:
    """The frame's mask, named by one of its keys, or beside its image; None: it has none.

    reduced: look first in masks_2, masks_4 or masks_8.
    """
    for key in MASKS:
        name = frame.get(key)
        if name is None or name == "":
            continue
        if not isinstance(name, str):
            raise ValueError(f"{label}: {key} must be a file name, got {_short(name)}")
        path = (folder.smaller(name) if reduced else None) or folder.image(name) or folder.smaller(name)
        if path is None:
            raise ValueError(f"{label}: mask {name!r} does not exist")
        return Mask(path)
    beside = image and image.with_name(f"{DYNAMIC}{image.stem}.png")
    return Mask(beside, inverted=True) if beside and beside.is_file() else None


def merged_lens(shared: Mapping[str, Any], own: Mapping[str, Any], label: str) -> dict[str, Any]:
    """The frame's keys about its lens. They win over those of the whole file; so does a focal length of any name."""
    first, second = (with_focal_lengths(keys, label) for keys in (own, shared))
    if any(first.get(key) is not None for key in FOCAL):
        second = {key: value for key, value in second.items() if key not in FOCAL}
    return {**second, **{key: value for key, value in first.items() if value is not None}}


def with_focal_lengths(keys: Mapping[str, Any], label: str) -> dict[str, Any]:
    """The keys about the lens; a matrix K and fields of view in degrees are translated."""
    lens = {key: keys[key] for key in LENS if key in keys}
    for degrees, radians in FIELDS_OF_VIEW.items():
        if lens.get(radians) is None:
            value = stated_numbers(keys, [degrees], label).get(degrees)
            lens[radians] = None if value is None else math.radians(value)
    if keys.get("K") is not None:
        lens = camera_matrix(keys["K"], label) | {key: value for key, value in lens.items() if value is not None}
    return lens


def camera_matrix(rows: Any, label: str) -> dict[str, float]:
    """fl_x, fl_y, cx and cy of K = [[fl_x, 0, cx], [0, fl_y, cy], [0, 0, 1]], 3 x 3 or the corner of a 4 x 4."""
    try:
        matrix = np.array(rows, dtype=np.float64)[:3, :3]
        sound = matrix.shape == (3, 3) and bool((np.abs(matrix) <= MAX_ENTRY).all())
    except (TypeError, ValueError, IndexError, OverflowError):
        sound = False
    if not sound:
        raise ValueError(f"{label}: K must be 3 x 3 numbers, got {_short(rows)}")
    (fl_x, skew, cx), (lower, fl_y, cy), last = matrix.tolist()
    if abs(skew) > 1e-6 * abs(fl_x) or lower != 0 or last != [0, 0, 1]:
        raise ValueError(f"{label}: K must be [[fl_x, 0, cx], [0, fl_y, cy], [0, 0, 1]], got {_short(rows)}")
    return {"fl_x": fl_x, "fl_y": fl_y, "cx": cx, "cy": cy}


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
            raise ValueError(
                f"{label}: transform_matrix must hold numbers of at most {MAX_ENTRY:g}, not NaN or infinity, got "
                f"{_short(value)}; leave out frames whose pose is not known"
            )
    return np.array(rows, dtype=np.float64)


def unread_keys(*contents: Mapping[str, Any]) -> Iterator[str]:
    """A remark on the keys of transforms files that no reader looks at; those that name files come first."""
    found: dict[str, bool] = {}
    for content in contents:
        for known, source in ((FILE_KEYS, content), *((FRAME_KEYS, frame) for frame in content["frames"])):
            for key in source.keys() - known:
                found[key] = found.get(key, False) or key.endswith(("path", "file", "filename", "filenames"))
    if found:
        yield f"keys not read: {shortened(sorted(found, key=lambda key: (not found[key], key)))}"
